"""The FTM Manager, and what it is made of; only its actor has a clock and sends anything."""

if __name__ != "rampart.manager":
    raise ImportError("import it as rampart.manager: everything of Rampart has this one name")
