"""What a run holds of the machine, counted from outside, and whether it grows with its deaths.

Those that outlive all deaths are looked at: the root, the process that watches the run, and the
world, which stands for any node that loses its partners and finds them again. Counts are compared
when nothing is under way. What may become more:

* Descriptors of all but the root, which has no session, by one connection for each partner. Zenoh
  dials a partner that it has lost while that dials it; one of the two connections then idles.
* Memory, by the record of the run in the process that watches it and by what Zenoh keeps.
"""

from __future__ import annotations

from pathlib import Path

import psutil

from rampart.actors.supervision.process_title import find_processes
from rampart.testing import RealRun
from tests.whole.chaos import ROOT_PROCESS

MAX_GROWTH_MB = 15.0


def count(run: RealRun, survivors: tuple[str, ...]) -> dict[str, float]:
    """Count what a run holds now; `survivors` are looked at one by one, and the root."""
    running = find_processes(run.port)
    pids = {ROOT_PROCESS: run.process.pid}
    pids |= {name: p.pid for name in survivors for p in running if name in p.names}
    family = {run.process.pid, *(p.pid for p in running)}
    counts: dict[str, float] = {
        "processes": len(running),
        "zombies": sum(p.info["status"] == psutil.STATUS_ZOMBIE and p.info["ppid"] in family
                       for p in psutil.process_iter(["status", "ppid"])),
        "files": sum(1 for _ in Path(run.info.folder).rglob("*")),
        "shared memory": sum(1 for _ in Path("/dev/shm").glob("*.zenoh"))}
    for name, process in ((name, psutil.Process(pid)) for name, pid in pids.items()):
        counts[f"descriptors of {name}"] = process.num_fds()
        counts[f"MB of {name}"] = round(process.memory_info().rss / 1e6, 1)
    return counts


def leaks(before: dict[str, float], after: dict[str, float]) -> list[str]:
    """Return what has become more, one line each; empty if nothing has leaked."""
    def allowed(what: str) -> float:
        if what.startswith("MB"):
            return MAX_GROWTH_MB
        is_root = what.endswith(f" {ROOT_PROCESS}")
        return before["processes"] if what.startswith("descriptors") and not is_root else 0

    return [f"{what}: {old} -> {after[what]}" for what, old in before.items()
            if after[what] > old + allowed(what)]
