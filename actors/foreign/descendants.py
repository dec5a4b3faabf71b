"""Descendants of programs: found in /proc, and killed.

The process of a command's node is the subreaper of its program (prctl(2)), so everything that the
program forks, in any session, stays below it. When the node's process ends, the root of the run
adopts the rest. A program starts in its own session, which the root and the nodes do not share, and
no process can join the session of another. So the root's orphans are known by their sessions.
"""

from __future__ import annotations

import contextlib
import os
import signal
import time
from collections.abc import Callable, Iterable

from rampart.actors.machine.unix_peer import stat_fields

END_S = 2.0
"""Wall seconds in which a killed process has to be gone; a process that is not waits for a disk."""


def _living() -> dict[int, tuple[int, int]]:
    """Return parent and session of each living process."""
    pids = [int(entry.name) for entry in os.scandir("/proc") if entry.name.isdecimal()]
    return {pid: found for pid in pids if (found := _parent_and_session(pid))}


def _parent_and_session(pid: int) -> tuple[int, int] | None:
    stat = stat_fields(pid)
    if not stat or stat[0] in b"ZX":
        return None
    _state, parent, _group, session = stat[:4]
    return int(parent), int(session)


def _below(living: dict[int, tuple[int, int]], tops: Iterable[int]) -> set[int]:
    found, fresh = set[int](), set(tops)
    while fresh:
        found |= fresh
        fresh = {pid for pid, (parent, _) in living.items() if parent in fresh} - found
    return found


def descendants(*of: int) -> set[int]:
    """Return the living descendants of these processes."""
    return _below(_living(), of) - set(of)


def is_below(pid: int, top: int) -> bool:
    """Whether a process lives and is a descendant of another one."""
    while pid != top and (found := _parent_and_session(pid)):
        pid = found[0]
    return pid == top


def kill_all(find: Callable[[], Iterable[int]]) -> None:
    """Kill until `find` returns nothing, for at most `END_S`."""
    until_s = time.monotonic() + END_S
    while (left := list(find())) and time.monotonic() < until_s:
        for pid in left:
            with contextlib.suppress(OSError):
                os.kill(pid, signal.SIGKILL)
        time.sleep(0.001)


def kill_orphans(root: int) -> None:
    """Kill what the root of a run has adopted from nodes that have ended; 0 is no root."""
    if root == 0:
        return

    def orphans() -> set[int]:
        living = _living()
        session = living.get(root, (0, 0))[1]
        return _below(living, (pid for pid, (parent, own) in living.items()
                               if parent == root and own != session))

    kill_all(orphans)
