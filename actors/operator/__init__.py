"""The operator's page: its node, its server, its contents and its requests."""
