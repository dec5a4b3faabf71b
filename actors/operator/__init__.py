"""The operator's page: its node, its server, what it shows and what may be asked."""
