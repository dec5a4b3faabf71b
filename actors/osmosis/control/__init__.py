"""The control nodes: pure cores, and the thin actors that wire them to topics."""
