"""Files, folders, streams and text that somebody else may have written: bounded, checked."""

if __name__ != "rampart.files":
    raise ImportError("import it as rampart.files: everything of Rampart has this one name")
