"""`rampart new`: a folder with a robot that runs, for its author to change.

The files are templates in `template/`, with `@NAME@` where the robot's name goes.
"""

from __future__ import annotations

import argparse
import importlib.util
import keyword
import re
import shutil
from importlib.resources import files
from pathlib import Path
from typing import Any

from rampart.cli.output import UsageError, say, using
from rampart.cli.verbs import add_verb, option

PLACES = {
    "robot.toml": "@NAME@.toml", "topics.py": "@NAME@/topics.py", "nodes.py": "@NAME@/nodes.py",
    "world.py": "@NAME@/world.py", "judge.py": "@NAME@/judge.py",
    "__init__.py": "@NAME@/__init__.py", "test_robot.py": "tests/test_@NAME@.py",
    "Makefile": "Makefile", "README.md": "README.md", "pyproject.toml": "pyproject.toml",
    "gitignore": ".gitignore"}
"""Templates, without `.txt`, and where they go in the new folder."""


def add(verbs: Any) -> None:
    """Add the verb to the parser."""
    add_verb(verbs, "new", "create a folder with a new robot", new,
             option("name", metavar="NAME", help="name of robot, folder and package: small "
                    "letters, digits and _, at most 31 characters"))


def new(options: argparse.Namespace) -> int:
    """Make the folder.

    Create a folder NAME with a robot that runs: two nodes, a simulated world, a
    judge, three mechanisms, tests, a README and a Makefile.

    Examples:
      rampart new courier
      cd courier; make run        # run it on processes
      make test                   # run its tests
    """
    name = options.name
    check(name)
    folder = Path(name)
    try:
        folder.mkdir()
    except FileExistsError:
        raise UsageError(f"{name}: exists already; nothing was changed") from None
    try:
        with using(folder):  # a write to a full disk names no file
            fill(folder, name)
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    say(f"{name}/ contains a robot that runs: cd {name}, then make run, make test; see README.md")
    return 0


def check(name: str) -> None:
    """Refuse a name that no package can have here.

    Raises:
        UsageError: it is such a name.
    """
    if not re.fullmatch(r"[a-z][a-z0-9_]{0,30}", name) or keyword.iskeyword(name):
        raise UsageError(f"NAME {name!r}: expected at most 31 small letters, digits and _, a "
                         "letter first, not a keyword of Python: it becomes the name of a package")
    if name in {"tests", "world", "controller", "driver", "manager"} or (
            not Path(name).exists() and importlib.util.find_spec(name) is not None):
        raise UsageError(f"NAME {name!r}: another module or node has this name already")


def fill(folder: Path, name: str) -> None:
    """Write all files into a new folder.

    Raises:
        OSError: one cannot be written.
    """
    templates = files("rampart.cli") / "template"
    for template, place in PLACES.items():
        text = (templates / f"{template}.txt").read_text(encoding="utf-8")
        file = folder / place.replace("@NAME@", name)
        file.parent.mkdir(exist_ok=True)
        with file.open("x", encoding="utf-8") as out:
            out.write(text.replace("@NAME@", name))
