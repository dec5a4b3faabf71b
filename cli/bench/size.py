"""What a system costs by its size: start, memory, processor time, and a killed node's way back."""

from __future__ import annotations

import os
import time
from collections.abc import Iterable, Sequence
from pathlib import Path

import msgspec

from rampart.actors.bus.topics import HEARTBEAT
from rampart.actors.ftm import topics
from rampart.actors.supervision.process_title import find_processes
from rampart.cli.bench.actors import TICK
from rampart.cli.bench.figures import Killed, Size, killed, ratio
from rampart.cli.bench.killing import Show, Victim, crashed, in_rounds
from rampart.cli.bench.processes.observer import Heard
from rampart.cli.bench.programs import BenchError
from rampart.cli.bench.systems import BESIDES, System, sized_system

LEAST = BESIDES + 2
"""Processes: a node hears another one, where there are more two others."""

TARGET = 3.0
"""A killed node of the largest system is to be back within so many times that of the smallest."""

_SETTLE_S = 2.0
_REST_S = 5.0
_PAUSE_S = 1.0
"""Between two kills of the same node, which has a spare again by then, as in the other parts."""
_MB = 1e6


def measure_size(sizes: Sequence[int], kills: int, folder: Path, show: Show) -> tuple[Size, ...]:
    """Start systems of so many processes, one after the other, and measure each.

    Args:
        sizes: Processes, from `LEAST` up.
        kills: Of a node in each.
        folder: For specifications and sockets.
        show: Shows what is being done.
    """
    rows: list[Size] = []
    for processes in sizes:
        try:
            row = _one(processes, kills, folder, show)
        except BenchError as error:
            row = Size(processes, note=str(error))
        smallest = rows[0] if rows else row
        rows.append(msgspec.structs.replace(row, times=ratio(row.output_ms, smallest.output_ms)))
    return tuple(rows)


def _one(processes: int, kills: int, folder: Path, show: Show) -> Size:
    file = folder / f"size{processes}.toml"
    file.write_text(sized_system(processes), encoding="utf-8")
    show(f"{processes} processes: starting")
    key = TICK.key.replace("{name}", "*")
    with System(file, folder, [key, HEARTBEAT.key.replace("{name}", "*")],
                [topics.PROCESS_EVENT.key]) as system:
        show(f"{processes} processes: at rest")
        time.sleep(_SETTLE_S)
        found = find_processes(system.port)
        again = sum(one.incarnation > 1 for one in found)
        pids = [system.program.pid, *{one.launcher for one in found}, *(one.pid for one in found)]
        cores = cores_of(pids, _REST_S)
        memory = [used for pid in pids if (used := memory_of(pid))]
        pss, uss = sum(one[0] for one in memory), sum(one[1] for one in memory)
        row = _killed(system, processes, kills, show)
    notes = [f"{len(pids)} were there" if len(pids) != processes else "",
             f"{again} were restarted at the start" if again else "", row.note]
    return Size(
        processes, round(system.start_s, 3), round(pss / len(memory) / _MB, 2),
        round(uss / len(memory) / _MB, 2), round(pss / _MB, 1), round(cores, 3),
        row.output_ms, note="; ".join(filter(None, notes)),
        samples_ms=tuple(kill.output for kill in row.kills if kill.output is not None))


def _killed(system: System, processes: int, kills: int, show: Show) -> Killed:
    """Kill a node from the middle of the system, again and again."""
    name = f"n{(processes - BESIDES) // 2}"

    def pid(_found: Heard) -> int:
        running = [one.pid for one in find_processes(system.port) if name in one.names]
        if not running:
            raise BenchError(f"{name} has no process")
        return running[-1]

    victim = Victim(
        name, name, ear=system.ear, keeper=system.program, teller=system.ear,
        ended=crashed(name), pid_of=pid,
        finds=lambda found: found.source == name and found.key == f"bench/tick/{name}")
    victim.wait()
    in_rounds([victim], kills, lambda text: show(f"{processes} processes: {text}"), _PAUSE_S)
    return killed(name, name, victim.kills, victim.note)


def cores_of(pids: Iterable[int], for_s: float) -> float:
    """Return how much processor time processes take in a second, on average over some seconds."""
    def used() -> dict[int, float]:
        found = {}
        for pid in known:
            try:
                text = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8")
            except OSError:  # it has ended
                continue
            found[pid] = ticks_of(text) / os.sysconf("SC_CLK_TCK")
        return found

    known = list(pids)
    begun_s, before = time.monotonic(), used()
    time.sleep(for_s)
    after, took_s = used(), time.monotonic() - begun_s
    return sum(after[pid] - before[pid] for pid in before.keys() & after.keys()) / took_s


def ticks_of(stat: str) -> int:
    """Return the processor time of a process by its /proc/PID/stat, in clock ticks (proc(5))."""
    fields = stat.rpartition(")")[2].split()
    return int(fields[11]) + int(fields[12])


def memory_of(pid: int) -> tuple[float, float] | None:
    """Return PSS and USS of a process, bytes; None if it has ended."""
    try:
        return memory_in(Path(f"/proc/{pid}/smaps_rollup").read_text(encoding="utf-8"))
    except OSError:
        return None


def memory_in(rollup: str) -> tuple[float, float]:
    """Return PSS and USS, bytes, that a /proc/PID/smaps_rollup says (proc(5))."""
    kb = {words[0].rstrip(":"): int(words[1]) for line in rollup.splitlines()
          if len(words := line.split()) == 3 and words[2] == "kB"}
    return kb["Pss"] * 1024.0, (kb["Private_Clean"] + kb["Private_Dirty"]) * 1024.0
