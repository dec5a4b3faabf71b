"""Everything that runs as an actor: a mailbox, a state, one message at a time."""

if __name__ != "rampart.actors":
    raise ImportError("import it as rampart.actors: everything of Rampart has this one name")
