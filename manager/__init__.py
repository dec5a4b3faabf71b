"""The FTM Manager and its parts; only the actor has a clock and sends messages."""

if __name__ != "rampart.manager":
    raise ImportError("import it as rampart.manager: everything of Rampart has this one name")
