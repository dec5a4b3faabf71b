"""Who may what on the bus: identities and their keys, and the rules that routers enforce."""
