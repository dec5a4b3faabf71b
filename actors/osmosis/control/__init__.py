"""The control nodes: pure cores and thin actors."""
