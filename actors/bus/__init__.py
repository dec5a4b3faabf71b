"""Topics, messages with bounds and envelopes, and the bus that carries them. Knows no robot."""
