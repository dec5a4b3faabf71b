"""The commands: `rampart` and `kill-node`, and what they share."""

if __name__ != "rampart.cli":
    raise ImportError("import it as rampart.cli: everything of Rampart has this one name")
