"""HTTP and WebSocket serving that strangers cannot bring down: access, limits, tokens."""
