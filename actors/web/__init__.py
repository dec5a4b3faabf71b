"""HTTP and WebSocket serving: access, TLS, limits, tokens, audit."""
