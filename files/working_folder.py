"""Import of custom actors from the working folder and from the folder of a specification.

With `-m` Python puts the working folder first on its path. If others can write the folder, their
code would run as this user. So processes of a run are started with `-P`, and these folders come
last, each only if no other user can write it.
"""

from __future__ import annotations

import os
import stat
import sys
from pathlib import Path

import rampart

refused: dict[str, str] = {}
"""Reason for each folder that is not searched."""


def admit(folder: Path | None = None) -> None:
    """Search a folder for modules after all others, if only this user can write it.

    Installed and shipped modules take precedence, so a file `json.py` in the folder has no effect.

    Args:
        folder: Folder of a specification named by the user; the working folder if None.
    """
    if why := why_not(folder):
        refused[str(folder or "")] = why
    elif (here := str((folder or Path.cwd()).resolve())) not in sys.path:
        sys.path.append(here)


def environment() -> dict[str, str]:
    """Return the environment of a process of a run, which finds this Rampart from any folder.

    Mathematical libraries get one thread, because the work is already divided among processes.
    """
    found = dict(os.environ, OPENBLAS_NUM_THREADS="1", OMP_NUM_THREADS="1")
    own = str(Path(rampart.__file__).resolve().parents[1])
    found["PYTHONPATH"] = os.pathsep.join([own, *filter(None, [os.environ.get("PYTHONPATH")])])
    return found


def why_not(folder: Path | None = None) -> str:
    """Return why a folder is not searched, "" if it is; argument as of `admit`."""
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
