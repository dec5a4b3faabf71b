"""What a run holds of the machine, counted from outside, and whether it grows with its deaths.

Those that outlive all deaths are looked at: the root, the process that watches the run, and the
world, which stands for any node that loses its partners and finds them again. Counts are compared
when nothing is under way. What may become more:

* Descriptors of all but the root, which has no session, by one connection for each partner. Zenoh
  dials a partner that it has lost while that dials it; one of the two connections then idles.
* Memory, by the record of the run in the process that watches it and by what Zenoh keeps.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import psutil

from rampart.actors.supervision.process_title import find_processes
from rampart.testing import RealRun
from tests.whole.chaos import ROOT_PROCESS

MAX_GROWTH_MB = 15.0

_OTHERS = ("joblib_", "sem.loky", "fastdds_", "sem.fastdds_")


@dataclass(frozen=True, slots=True)
class Counts:
    """What was there at one moment; the first two by name of a process that survives.

    `files` are those in the folder of the run, its sockets among them.
    """

    descriptors: dict[str, int]
    memory_mb: dict[str, float]
    processes: int
    zombies: int
    files: int
    shared_memory: frozenset[str]

    def __str__(self) -> str:
        each = "  ".join(
            f"{name} {self.descriptors[name]} fd {memory:.1f} MB"
            for name, memory in self.memory_mb.items())
        return (f"{each}  | {self.processes} processes, {self.zombies} zombies, "
                f"{self.files} files in the folder, "
                f"{len(self.shared_memory)} in shared memory")


def count(run: RealRun, survivors: tuple[str, ...]) -> Counts:
    """Count what a run holds now; `survivors` are looked at one by one, and the root."""
    running = find_processes(run.port)
    pids = {ROOT_PROCESS: run.process.pid}
    pids |= {name: p.pid for name in survivors for p in running if name in p.names}
    one_by_one = {name: psutil.Process(pid) for name, pid in pids.items()}
    family = {run.process.pid, *(p.pid for p in running)}
    return Counts(
        {name: p.num_fds() for name, p in one_by_one.items()},
        {name: p.memory_info().rss / 1e6 for name, p in one_by_one.items()},
        len(running),
        sum(p.info["status"] == psutil.STATUS_ZOMBIE and p.info["ppid"] in family
            for p in psutil.process_iter(["status", "ppid"])),
        sum(1 for _ in Path(run.info.folder).rglob("*")),
        shared_memory(run.port))


def shared_memory(port: int = 0) -> frozenset[str]:
    """Return the names of shared memory segments, without those of programs that may run beside.

    Args:
        port: Base port of the run; folders of other runs are left out.
    """
    names = (entry.name for entry in Path("/dev/shm").iterdir())
    return frozenset(name for name in names if not name.startswith(_OTHERS) and (
        not name.startswith("rampart-") or name.startswith(f"rampart-{port}-")))


def leaks(before: Counts, after: Counts) -> list[str]:
    """Return what has become more, one line each; empty if nothing has leaked."""
    found = [
        f"{name}: descriptors {old} -> {after.descriptors[name]}"
        for name, old in before.descriptors.items()
        if after.descriptors[name] > old + before.processes * (name != ROOT_PROCESS)]
    found += [
        f"{name}: memory {mb:.1f} -> {after.memory_mb[name]:.1f} MB"
        for name, mb in before.memory_mb.items() if after.memory_mb[name] > mb + MAX_GROWTH_MB]
    found += [
        f"{what}: {old} -> {new}"
        for what, old, new in (("processes", before.processes, after.processes),
                               ("files", before.files, after.files),
                               ("zombies", before.zombies, after.zombies))
        if new > old]
    return found + [f"shared memory: {name}"
                    for name in sorted(after.shared_memory - before.shared_memory)]
