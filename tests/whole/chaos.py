"""Chaos: hits whatever process of a running system, in whatever way, and sees that it comes back.

The plan is pure and seeded: who is hit how, and how long after the one before. The executor waits
until the victim has gone and another has taken its place, so that hits come in turn.

Some processes are special:

* The root is what a run *is*: its end ends the run. That it leaves nothing behind is
  `tests/whole/test_launch.py`'s subject.
* The world is only stopped for a moment. It stands for the real one, ground truth included: with
  its process the place of the robot is gone, and nobody can bring that back; the supervisor does
  not try. A wedged loop never turns again, so that would be its death too.
* The process that watches the run has the verdict: its end ends the run, too. Stopped, it is
  continued by the root.
* A process of the pool is no node: any other one of the pool counts as its replacement.
"""

from __future__ import annotations

import os
import random
import re
import signal
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rampart.actors.bus.run_folder import ROUTERS
from rampart.actors.osmosis.control.following.route_control import CONTROL_STATE
from rampart.actors.osmosis.control.mission.mission_state import MISSION_STATE
from rampart.actors.runtime.checkpoint import StateFormat
from rampart.actors.runtime.checkpoint_file import read
from rampart.actors.runtime.run_plan import SUPERVISOR
from rampart.actors.supervision.kill_node import SIGNALS
from rampart.actors.supervision.process_title import find_processes, process_state
from rampart.actors.supervision.root import POOL
from rampart.manager.spec.schema import Kind, SystemSpec
from rampart.testing import RealRun

WAYS = ("KILL", "STOP", "SEGV", "WEDGE")
BACK_WITHIN_S = 10.0
"""Wall seconds after which a victim counts as not having come back; a loaded machine is slow."""

WORLD_PAUSE_S = 0.4
"""So long the world is stopped, simulated seconds: the Safety Pilot misses the laser and stops. An
emergency stop, the right answer to a robot without senses, would follow after a second."""

_ENDED = re.compile(r"\] mission \S+ (succeeded|failed|cancelled)")

@dataclass(frozen=True, slots=True)
class Hit:
    """One process to be hit: `pause_s` wall seconds after the one before was repaired."""

    pause_s: float
    name: str
    way: str


@dataclass(frozen=True, slots=True)
class Targets:
    """What can be hit: `mortal` in every way, `world` only by being stopped for a moment."""

    mortal: tuple[str, ...]
    world: tuple[str, ...]


def targets(spec: SystemSpec) -> Targets:
    """Return the processes of a system, one name for each, and those that every system has."""
    nodes = {unit: members[0] for unit, members in spec.processes().items()}
    world = tuple(n.name for n in nodes.values() if n.kind is Kind.WORLD)
    mortal = tuple(n.name for n in nodes.values() if n.kind is not Kind.WORLD)
    return Targets((*mortal, SUPERVISOR, *ROUTERS, POOL), world)


def each_in_every_way(of: Targets, seed: int, pause_s: tuple[float, float]) -> list[Hit]:
    """Return four rounds in which everybody is hit, each time in another way.

    Nobody is hit twice in succession: who comes back is given a moment.
    """
    dice = random.Random(f"chaos {seed}")
    ways = {name: dice.sample(WAYS, len(WAYS)) for name in of.mortal}
    ways |= {name: ["STOP"] * len(WAYS) for name in of.world}
    hits: list[Hit] = []
    for i in range(len(WAYS)):
        names = dice.sample(list(ways), len(ways))
        if hits and names[0] == hits[-1].name:
            names.reverse()
        hits += [Hit(dice.uniform(*pause_s), name, ways[name][i]) for name in names]
    return hits


def so_many(names: Sequence[str], count: int, seed: int, pause_s: tuple[float, float]
            ) -> list[Hit]:
    """Return `count` hits of random processes in random ways, nobody twice in succession."""
    dice = random.Random(f"chaos {seed}")
    hits: list[Hit] = []
    for _ in range(count):
        others = [name for name in names if not hits or name != hits[-1].name]
        hits.append(Hit(dice.uniform(*pause_s), dice.choice(others), dice.choice(WAYS)))
    return hits


@dataclass(frozen=True, slots=True)
class Struck:
    """A hit that was carried out: when (wall s since the run was ready), and how long it took.

    `back_s` is from the signal until another process bears the name and the old one is gone; None
    if that did not happen within `BACK_WITHIN_S`.
    """

    at_s: float
    hit: Hit
    pid: int
    back_s: float | None

    def __str__(self) -> str:
        took = "NOT BACK" if self.back_s is None else f"back in {self.back_s * 1000:5.0f} ms"
        return f"{self.at_s:7.2f} s  {self.hit.way:<5} {self.hit.name:<16} pid {self.pid:<8} {took}"


def tells_end(story: str) -> bool:
    """Whether the mission has ended, by what its run told."""
    return _ENDED.search(story) is not None


class Chaos:
    """Carries out hits on a run.

    Args:
        run: the run, its mission under way.
        world: processes that are stopped for a moment only.
        told: called with each hit that was carried out.
    """

    def __init__(self, run: RealRun, world: Sequence[str] = (),
                 told: Callable[[Struck], None] = lambda _: None) -> None:
        self.struck: list[Struck] = []
        self._run = run
        self._world = world
        self._told = told
        self._rate = run.info.rate
        self._begun_s = time.monotonic()

    def carry_out(self, hits: Iterable[Hit]) -> list[Hit]:
        """Hit one after the other while the run lasts; return what was left to be done."""
        hits = list(hits)
        for i, hit in enumerate(hits):
            if not self._rest(hit.pause_s) or not self._strike(hit):
                return hits[i:]
        return []

    @property
    def elapsed_s(self) -> float:
        """Wall seconds since the first hit was allowed."""
        return time.monotonic() - self._begun_s

    def _over(self) -> bool:
        return self._run.process.poll() is not None or tells_end(self._run.story)

    def _rest(self, pause_s: float) -> bool:
        until = time.monotonic() + pause_s
        while time.monotonic() < until and not self._over():
            time.sleep(0.02)
        return not self._over()

    def _strike(self, hit: Hit) -> bool:
        """Hit and wait for the repair; False if the run was over before it was done."""
        start_s, old = time.monotonic(), self._run.pid(hit.name)
        if old is not None:
            os.kill(old, SIGNALS[hit.way])
            if hit.name in self._world:
                time.sleep(WORLD_PAUSE_S / self._rate)
                os.kill(old, signal.SIGCONT)
        while time.monotonic() - start_s < BACK_WITHIN_S:
            if old is not None and self._is_back(hit, old):
                self._note(hit, old, time.monotonic() - start_s)
                return True
            if self._over():
                return False
            time.sleep(0.005)
        self._note(hit, old or 0, None)  # without a pid: it had failed by itself, as bad as that
        return True

    def _is_back(self, hit: Hit, old: int) -> bool:
        new = self._run.pid(hit.name)
        if hit.name in self._world:
            return new == old and process_state(old) in "SR"
        return new not in {None, old} and process_state(old) in "XZ"

    def _note(self, hit: Hit, pid: int, back_s: float | None) -> None:
        at_s = time.monotonic() - self._begun_s - (back_s or 0.0)
        self.struck.append(Struck(at_s, hit, pid, back_s))
        self._told(self.struck[-1])


def complaints(run: RealRun, code: int, result: dict[str, Any], rows: str,
               struck: Sequence[Struck]) -> list[str]:
    """Return what is wrong with a run that has ended; empty if all is as it has to be.

    Args:
        run: the run.
        code: exit code of `launch.py`.
        result: what it printed with --json.
        rows: letters of the rows of lights that the mission passes.
        struck: what was done to it.
    """
    wrong = [f"not back: {done}" for done in struck if done.back_s is None]
    if (code, result["mission"], result["safety"]) != (0, "success", "safe"):
        wrong.append(f"exit code {code}, {result['mission']}, {result['safety']}: "
                     + "; ".join(result["reasons"]))
    wrong += [f"left over: {p}" for p in find_processes(run.port)]
    told = run.story
    wrong += [f"told: {line}" for line in told.splitlines()
              if "UNSAFE" in line or "given up" in line]
    return wrong + _lights_wrong(Path(result["report"]).parent, result, rows)


def _lights_wrong(report: Path, result: dict[str, Any], rows: str) -> list[str]:
    """Compare the three who know of lights: the result, and both nodes' checkpoints.

    A light that was measured twice has two intensities, and one of the three the other one.
    """
    expected = sorted(x["name"] for x in result["lights"] if x["row"] in rows)
    run_id = Path(result["report"]).stem.removeprefix("inspection-")
    state = _newest(report / "checkpoints", "mission_manager", run_id, MISSION_STATE)
    kept = _newest(report / "checkpoints", "osmosis_control", run_id, CONTROL_STATE)
    told = {x["name"]: x["intensity_cd"] for x in result["lights"]
            if x["verdict"] != "not measured"}
    wrong = []
    for who, lights in (("mission_manager", state.lights),
                        ("osmosis_control", kept.lights.measured)):
        if sorted(x.light for x in lights) != expected:
            wrong.append(f"lights of {who}: {sorted(x.light for x in lights)}, not {expected}")
        if {x.light: x.intensity_cd for x in lights} != told:
            wrong.append(f"lights of {who} have other values than the result's")
    return wrong


def _newest(folder: Path, node: str, run_id: str, form: StateFormat[Any]) -> Any:
    record = read(folder, node, run_id).records[0]
    return form.decode(record.version, record.state)
