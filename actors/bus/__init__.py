"""Topics, messages, their bounds and envelopes, and the bus that carries them. Knows no robot."""
