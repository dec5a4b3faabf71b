"""Everything that runs as an actor: a mailbox, a state, one message at a time."""
