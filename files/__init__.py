"""Bounded and checked reading of files, folders, streams and text of other writers."""

if __name__ != "rampart.files":
    raise ImportError("import it as rampart.files: everything of Rampart has this one name")
