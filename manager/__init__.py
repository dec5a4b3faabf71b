"""The FTM Manager: specification, strategies, arbitration, analyses; pure but for its actor."""

if __name__ != "rampart.manager":
    raise ImportError("import it as rampart.manager: everything of Rampart has this one name")
