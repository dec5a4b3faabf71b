"""Whether actors of one's own are looked for in the working folder, and beside a specification.

With `-m` Python puts that folder first on its path, and executes what it finds there: in a folder
that others can write, their code as this user. So processes of a run are started with `-P`, and
these folders come last, each if only this user can write it.
"""

from __future__ import annotations

import os
import stat
import sys
from pathlib import Path

import rampart

refused: dict[str, str] = {}
"""Why folders are not searched, by the folder."""


def admit(folder: Path | None = None) -> None:
    """Have modules in a folder found, after all others, if only this user can write it.

    What is installed, and what ships, comes first: a file `json.py` in the folder changes nothing.

    Args:
        folder: of a specification that the user has named; the working folder if None.
    """
    if why := why_not(folder):
        refused[str(folder or "")] = why
    elif (here := str((folder or Path.cwd()).resolve())) not in sys.path:
        sys.path.append(here)


def environment() -> dict[str, str]:
    """Return the environment of a process of a run: it finds this Rampart, from any folder.

    The mathematical libraries get one thread: there are as many processes as there is work.
    """
    found = dict(os.environ, OPENBLAS_NUM_THREADS="1", OMP_NUM_THREADS="1")
    own = str(Path(rampart.__file__).resolve().parents[1])
    found["PYTHONPATH"] = os.pathsep.join([own, *filter(None, [os.environ.get("PYTHONPATH")])])
    return found


def why_not(folder: Path | None = None) -> str:
    """Return why modules in a folder are not looked for, "" if they are; argument as of `admit`."""
    what = "the working folder" if folder is None else str(folder)
    try:
        folder = folder or Path.cwd()
        found = folder.stat()
    except OSError as error:
        return f"{what} is gone ({error.strerror})"
    if found.st_uid != os.getuid():
        return f"{folder} belongs to another user"
    own_group = found.st_gid == os.getgid() == os.getuid()  # a group of this user alone
    if found.st_mode & (stat.S_IWOTH | (0 if own_group else stat.S_IWGRP)):
        return f"others can write {folder} (mode {stat.S_IMODE(found.st_mode):o})"
    return ""
