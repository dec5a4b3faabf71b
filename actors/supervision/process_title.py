"""Names of processes as `ps` shows them, and the way back from a name to its process.

The title is the registry: a restarted supervisor, `kill-node` and the clean-up after a killed
launcher find a run's processes in /proc, with no file that could be stale and no bus that could
be down. Format: `rampart[PORT/LAUNCHER] NAME #INCARNATION`, where LAUNCHER is
the launcher's pid, which tells two runs on one port apart; several actors in one process are `A+B`.
"""

from __future__ import annotations

import os
import re
import signal
from dataclasses import dataclass
from pathlib import Path

import setproctitle

from rampart.actors.bus.run_folder import remove
from rampart.actors.foreign.descendants import kill_programs
from rampart.actors.machine.unix_peer import process_state

RUN = "run"
"""The process that watches a run, if it is a child of the root."""

POOL = "pool"
"""A process of the pool."""

_TITLE = re.compile(r"^rampart\[(\d{1,5})/(\d{1,10})\] ([\w+.-]+) #(\d{1,20})(?!\d)")

# It finds the room for titles from the environment's first variable, the first time it is called:
# now, as long as none has been replaced.
setproctitle.getproctitle()


@dataclass(frozen=True, slots=True)
class RunProcess:
    """A process of a run as found in /proc."""

    pid: int
    port: int
    launcher: int
    names: tuple[str, ...]
    incarnation: int


def set_title(port: int, launcher: int, names: tuple[str, ...], incarnation: int) -> None:
    """Name the calling process."""
    setproctitle.setproctitle(f"rampart[{port}/{launcher}] {'+'.join(names)} #{incarnation}")
    setproctitle.setthreadtitle("+".join(names)[:15])


def parse_title(pid: int, title: str) -> RunProcess | None:
    """Return what a process title says, or None if it is none of ours."""
    match = _TITLE.match(title)
    if match is None:
        return None
    return RunProcess(pid, int(match[1]), int(match[2]), tuple(match[3].split("+")), int(match[4]))


def find_processes(port: int | None = None, launcher: int | None = None) -> list[RunProcess]:
    """Return the running processes of all runs of this user, or of one base port or launcher.

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
        return None  # it ended while we looked
    process = parse_title(int(entry.name), raw.rstrip(b"\0").decode(errors="replace"))
    return process if process and process_state(process.pid) not in "ZX" else None


def kill(pid: int, number: signal.Signals = signal.SIGKILL) -> bool:
    """Send a signal to a process; False if it is gone."""
    try:
        os.kill(pid, number)
    except ProcessLookupError:
        return False
    return True


def end_run(launcher: int, folder: str) -> None:
    """Leave nothing of a run whose launcher has ended but this process: nor its folder."""
    kill_programs(process.pid for process in find_processes(launcher=launcher))
    for process in find_processes(launcher=launcher):
        if process.pid != os.getpid():
            kill(process.pid)
    remove(folder)
