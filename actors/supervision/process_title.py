"""Titles of processes, as `ps` shows them, and the search for a process by its title.

The title is the registry. A restarted supervisor, `kill-node` and the clean-up after a killed root
find the processes of a run in /proc, without a file that could be stale or a bus that could fail.
Format: `rampart[PORT/ROOT] NAME #INCARNATION`. ROOT is the root's pid, which distinguishes two runs
on one port. Several actors in one process are `A+B`.
"""

from __future__ import annotations

import os
import re
import signal
from dataclasses import dataclass
from pathlib import Path

import setproctitle

from rampart.actors.bus.run_folder import remove
from rampart.actors.foreign.descendants import descendants, kill_all
from rampart.actors.machine.unix_peer import process_state

RUN = "run"
"""The process that watches a run, if it is a child of the root."""

POOL = "pool"
"""A process of the pool."""

_TITLE = re.compile(r"^rampart\[(\d{1,5})/(\d{1,10})\] ([\w+.-]+) #(\d{1,20})(?!\d)")

# The first call finds the memory for titles, by the first variable of the environment. So it comes
# now, before a variable is replaced.
setproctitle.getproctitle()


@dataclass(frozen=True, slots=True)
class RunProcess:
    """A process of a run in /proc.

    Attributes:
        launcher: pid of its root.
        is_program: whether it is the program of a command, which leads a process group.
    """

    pid: int
    port: int
    launcher: int
    names: tuple[str, ...]
    incarnation: int
    is_program: bool = False


def set_title(port: int, launcher: int, names: tuple[str, ...], incarnation: int) -> None:
    """Name the calling process."""
    setproctitle.setproctitle(f"rampart[{port}/{launcher}] {'+'.join(names)} #{incarnation}")
    setproctitle.setthreadtitle("+".join(names)[:15])


def parse_title(pid: int, title: str) -> RunProcess | None:
    """Parse a process title; None if it is not of a run."""
    match = _TITLE.match(title)
    if match is None:
        return None
    return RunProcess(pid, int(match[1]), int(match[2]), tuple(match[3].split("+")), int(match[4]))


def find_processes(port: int | None = None, launcher: int | None = None) -> list[RunProcess]:
    """Return the processes of this user's runs, of all or of one base port or root.

    Zombies are left out: they run no code and hold nothing.
    """
    found = [process for entry in Path("/proc").iterdir() if entry.name.isdecimal()
             and (process := _process_at(entry))
             and port in {None, process.port} and launcher in {None, process.launcher}]
    return sorted(found, key=lambda p: (p.port, p.pid))


def _process_at(entry: Path) -> RunProcess | None:
    try:
        raw = (entry / "cmdline").read_bytes()
        if not raw.startswith(b"rampart[") or entry.stat().st_uid != os.getuid():
            return None
    except OSError:
        return None  # it has just ended
    process = parse_title(int(entry.name), raw.rstrip(b"\0").decode(errors="replace"))
    return process if process and process_state(process.pid) not in "ZX" else None


def kill(pid: int, number: signal.Signals = signal.SIGKILL) -> bool:
    """Send a signal to a process; False if it has ended."""
    try:
        os.kill(pid, number)
    except ProcessLookupError:
        return False
    return True


def end_run(launcher: int, folder: str) -> None:
    """End all other processes of a run whose root has ended, and remove its folder."""
    nodes = [process.pid for process in find_processes(launcher=launcher)]
    kill_all(lambda: descendants(*nodes))
    for process in find_processes(launcher=launcher):
        if process.pid != os.getpid():
            kill(process.pid)
    remove(folder)
