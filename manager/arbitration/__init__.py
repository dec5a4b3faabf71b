"""From reports to commands: the arbiter, step by step, and what it remembers."""
