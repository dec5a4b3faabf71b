"""What cannot be beaten, measured in the same run: a fork, an interpreter, a round trip, physics.

A package with a world adds its own floor by an entry point of the group `rampart.floors`: a
function without arguments that returns its `Physics`.
"""

from __future__ import annotations

import contextlib
import os
import select
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from importlib.metadata import entry_points
from pathlib import Path
from typing import NamedTuple

from rampart.cli.bench.actors import PING, PING_HZ
from rampart.cli.bench.figures import Floor, Killed, ratio, spread
from rampart.cli.bench.killing import Show, heard
from rampart.cli.bench.peers import ACTOR, COMMAND
from rampart.cli.bench.programs import BenchError, Program, of_ours
from rampart.cli.bench.systems import START_S, System, talking_system
from rampart.sim.campaign.job import Job, run_virtually

TRIP_TARGET = 1.25
"""A round trip between two actors is to take at most so many times that without actors."""

_STARTS_PER_KILL = 3
_TRIP_ROUNDS = 3
_TRIP_S = 2.0
_STEPS_S = 0.5
_WAIT_S = 60.0

_FORKS = """
import os, time
for _ in range(int(__import__("sys").argv[1])):
    read, write = os.pipe()
    begun = time.monotonic()
    child = os.fork()
    if not child:
        os.write(write, b"1")
        os._exit(0)
    os.read(read, 1)
    print(time.monotonic() - begun, flush=True)
    os.waitpid(child, 0)
    os.close(read); os.close(write)
"""


class Physics(NamedTuple):
    """What an entry point of the group `rampart.floors` returns.

    Attributes:
        system: Shipped system, or path, whose world this is.
        step_s: Simulated seconds of a step.
        step: Makes one.
    """

    system: str
    step_s: float
    step: Callable[[], object]


def measure_floors(kills: int, folder: Path, show: Show,
                   peers: Sequence[Killed] = ()) -> tuple[Floor, ...]:
    """Measure all floors, and what is compared with them.

    Args:
        kills: Forks and interpreters are started three times as often.
        folder: For systems and sockets.
        show: Shows what is being done.
        peers: What the peers' part of this run has found; without it, restarts have no ratio.
    """
    restarts = {row.name: row.output_ms for row in peers}
    starts = kills * _STARTS_PER_KILL
    show("fork")
    fork = spread([float(line) * 1e3 for line in subprocess.run(  # noqa: S603 our interpreter
        [sys.executable, "-I", "-S", "-c", _FORKS, str(starts)], check=True, text=True,
        capture_output=True, timeout=_WAIT_S).stdout.split()])
    show("python -c pass")
    python = spread([_start() for _ in range(starts)])
    floors = [
        Floor("fork", "fork, to the child's first instruction", "ms", fork,
              "restart of Rampart's actor", restarts.get(ACTOR),
              ratio(restarts.get(ACTOR), fork)),
        Floor("python", "python -c pass, from start to end", "ms", python,
              "restart of Rampart's command", restarts.get(COMMAND),
              ratio(restarts.get(COMMAND), python))]
    floors.append(_trips(folder, show))
    floors += [_physics(entry.name, entry.load(), show)
               for entry in sorted(entry_points(group="rampart.floors"), key=lambda e: e.name)]
    return tuple(floors)


def _start() -> float:
    """Return how long an interpreter takes from start to end, milliseconds.

    Its end is told by the kernel: `Popen.wait` with a timeout looks in steps of up to 50 ms.
    """
    begun_s = time.monotonic()
    with subprocess.Popen([sys.executable, "-c", "pass"]) as process:
        ended = os.pidfd_open(process.pid)
        try:
            if not select.select([ended], [], [], _WAIT_S)[0]:
                process.kill()
            return (time.monotonic() - begun_s) * 1e3
        finally:
            os.close(ended)


def _trips(folder: Path, show: Show) -> Floor:
    """Compare round trips without and with actors, in turn."""
    title = "Zenoh round trip: two asyncio loops, two processes, two routers"
    raw: list[float] = []
    ours: list[float] = []
    note = ""
    file = folder / "talk.toml"
    file.write_text(talking_system(), encoding="utf-8")
    try:
        for number in range(_TRIP_ROUNDS):
            show(f"round trip without actors, {number + 1} of {_TRIP_ROUNDS}")
            raw += _raw_trips(folder, number)
            show(f"round trip of actors, {number + 1} of {_TRIP_ROUNDS}")
            ours += trips_of_actors(file, folder)
    except BenchError as error:
        note = str(error)
    floor, against = spread([1e3 * s for s in raw]), spread([1e3 * s for s in ours])
    return Floor("trip", title, "ms", floor, "round trip of two actors", against,
                 ratio(against, floor), TRIP_TARGET, note)


def _raw_trips(folder: Path, number: int) -> list[float]:
    ends = [f"unixsock-stream/{folder}/raw{number}{end}" for end in "ab"]
    with contextlib.ExitStack() as running:
        for role, where in (("router", ends), ("router", ends[::-1]), ("answerer", ends),
                            ("asker", ends)):
            program = running.enter_context(Program(
                f"raw {role}", of_ours("raw_trip", role, *where), folder))
            program.wait_for(lambda line: line.text == "ready" or None, START_S, "its first line")
        time.sleep(_TRIP_S)
        return _settled([float(line.text) for line in program.lines
                         if line.text != "ready"], "raw asker")


def trips_of_actors(file: Path, folder: Path, keys: str = "") -> list[float]:
    """Return round trips of the two actors of `talking_system`, seconds.

    Args:
        file: the system.
        folder: for checkpoints.
        keys: folder of keys; "" for none.

    Raises:
        BenchError: it cannot be started, or too little was heard.
    """
    with System(file, folder, changes=[PING.key], keys=keys) as system:
        time.sleep(_TRIP_S)
        found = [said for line in list(system.ear.lines) if (said := heard(line))]
        return _settled([said.body["last_s"] for said in found if said.body["last_s"] > 0],
                        "actors")


def _settled(trips: list[float], whose: str) -> list[float]:
    """Return round trips without those of the first moments."""
    warm = round(PING_HZ / 4)
    if len(trips) <= warm:
        raise BenchError(f"{whose}: {len(trips)} round trips in {_TRIP_S:g} s")
    return trips[warm:]


def _physics(name: str, floor: Callable[[], Physics], show: Show) -> Floor:
    """Compare a simulated second of a system in virtual time with its physics alone."""
    show(f"{name}: physics alone")
    physics = floor()
    steps = max(1, round(_STEPS_S / physics.step_s))
    alone = []
    for _ in range(_TRIP_ROUNDS + 1):
        begun_s = time.process_time()
        for _ in range(steps):
            physics.step()
        alone.append((time.process_time() - begun_s) / (steps * physics.step_s) * 1e3)
    job = Job(row="none", system=physics.system)
    run_virtually(job)  # imports, compiles, loads the map
    whole = []
    for number in range(_TRIP_ROUNDS):
        show(f"{name}: {physics.system} in virtual time, {number + 1} of {_TRIP_ROUNDS}")
        begun_s = time.process_time()
        simulated_s = run_virtually(job).record.duration_s
        whole.append((time.process_time() - begun_s) / simulated_s * 1e3)
    floor_ms, against = spread(alone[1:]), spread(whole)
    return Floor(name, "physics alone, processor time of a simulated second", "ms", floor_ms,
                 f"all of {Path(physics.system).stem} in virtual time", against,
                 ratio(against, floor_ms))
