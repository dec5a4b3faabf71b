"""Processes of commands that nobody keeps any more, found by their environment in /proc.

A keeper leaves nothing (`rampart.actors.foreign.keeper`), unless it is killed itself. What its
command had forked has the run and the node in its environment, which a process inherits. Not found
is what has replaced its environment *and* lost its keeper, and what runs as another user.
"""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

from rampart.actors.foreign.keeper import kill_all

FOLDER, NODE = "RAMPART_FOLDER", "RAMPART_NODE"

_WITHIN_S = 1.0


def find_strays(folder: str, node: str = "") -> list[int]:
    """Return the processes of the commands of a run, or of one node."""
    marks = {f"{FOLDER}={folder}".encode(), *([f"{NODE}={node}".encode()] if node else [])}
    found = []
    for entry in os.scandir("/proc"):
        if entry.name.isdecimal():
            with contextlib.suppress(OSError):
                environment = Path(entry.path, "environ").read_bytes()
                if marks <= set(environment.split(b"\0")):
                    found.append(int(entry.name))
    return [pid for pid in found if pid != os.getpid()]


def kill_strays(folder: str, node: str = "") -> bool:
    """Kill them and wait until they are gone; False if something is left after a second."""
    return not folder or kill_all(lambda: find_strays(folder, node), _WITHIN_S)
