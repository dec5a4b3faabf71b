"""Chaos: hits processes of a running system, and checks that each of them comes back.

A plan is pure and seeded: which processes are hit, how, and how long after the strike before.
`Chaos` carries strikes out one by one, and waits each time until every victim is gone and another
process has taken its place. If asked, it also waits until the whole system is back: the
supervisor's table has all nodes running in the processes that /proc shows, with a heartbeat since
the repair.

Two processes are only stopped for a moment (`PAUSE`):

* The root, whose end is the run's. `test_launch.py` checks that nothing is left behind then.
* The world. It stands for the real one, ground truth included, and is not restarted.

A process of the pool is no node: any other one of the pool counts as its replacement.
"""

from __future__ import annotations

import contextlib
import json
import os
import random
import re
import signal
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, product
from pathlib import Path
from typing import Any

from rampart.actors.bus.run_folder import ROUTERS
from rampart.actors.osmosis.control.following.route_control import CONTROL_STATE
from rampart.actors.osmosis.control.mission.mission_state import MISSION_STATE
from rampart.actors.runtime.checkpoint_file import read
from rampart.actors.runtime.clock import Clock
from rampart.actors.runtime.run_plan import SUPERVISOR
from rampart.actors.supervision.kill_node import SIGNALS
from rampart.actors.supervision.process_title import find_processes, process_state
from rampart.actors.supervision.root import POOL
from rampart.manager.spec.schema import Kind, SystemSpec
from rampart.testing import RealRun
from tests.real_tools import printed

ROOT_PROCESS = "root"
WAYS = ("KILL", "STOP", "SEGV", "WEDGE")
PAUSE = "PAUSE"
BACK_WITHIN_S = 10.0
"""Wall seconds for each victim of a strike, on a machine that may be busy."""

WORLD_PAUSE_S = 0.4
"""Simulated seconds: the Safety Pilot misses the laser and stops. After a second an emergency stop
would follow, the right answer to a robot without senses."""

ROOT_PAUSE_S = (0.3, 1.5)
GAP_S = 0.4
"""The second of a pair is hit at once, or up to so many wall seconds later."""

EMERGENCY_STOP = "RM1"

_ENDED = re.compile(r"\] mission \S+ (succeeded|failed|cancelled)")
_DECISION = re.compile(r"\] decision \d+: (.*)")


@dataclass(frozen=True, slots=True)
class Hit:
    """A process and how it is hit; wall seconds until it goes on, if it is only paused."""

    name: str
    way: str
    pause_s: float = 0.0


@dataclass(frozen=True, slots=True)
class Strike:
    """Processes that are hit, `gap_s` wall seconds apart, `after_s` after the last repair."""

    hits: tuple[Hit, ...]
    after_s: float = 0.0
    gap_s: float = 0.0

    @property
    def names(self) -> tuple[str, ...]:
        """Victims."""
        return tuple(hit.name for hit in self.hits)

    def __str__(self) -> str:
        victims = "  ".join(f"{hit.way:<5} {hit.name:<16}" for hit in self.hits)
        return victims + (f" {self.gap_s * 1e3:3.0f} ms apart" if len(self.hits) > 1 else "")


@dataclass(frozen=True, slots=True)
class Targets:
    """Processes that can be hit in every way, and those that are only paused."""

    mortal: tuple[str, ...]
    paused: tuple[str, ...]

    def hit(self, dice: random.Random, name: str, ways: Sequence[str] = WAYS) -> Hit:
        """Return a hit of a process in a way that is drawn."""
        if name in self.paused:
            return Hit(name, PAUSE, dice.uniform(*ROOT_PAUSE_S) if name == ROOT_PROCESS
                       else WORLD_PAUSE_S)
        return Hit(name, dice.choice(ways))


def targets(spec: SystemSpec) -> Targets:
    """Return the processes of a system, one name for each, and those that every system has."""
    nodes = [members[0] for members in spec.processes().values()]
    mortal = tuple(node.name for node in nodes if node.kind is not Kind.WORLD)
    world = tuple(node.name for node in nodes if node.kind is Kind.WORLD)
    return Targets((*mortal, SUPERVISOR, *ROUTERS, POOL), (*world, ROOT_PROCESS))


def each_in_every_way(of: Targets, seed: int, after_s: tuple[float, float]) -> list[Strike]:
    """Return four rounds in which every process is hit, each time in another way.

    No process is hit twice in succession.
    """
    dice = random.Random(f"chaos {seed}")
    ways = {name: dice.sample(WAYS, len(WAYS)) for name in of.mortal}
    strikes: list[Strike] = []
    for i in range(len(WAYS)):
        names = dice.sample([*of.mortal, *of.paused], len(of.mortal) + len(of.paused))
        if strikes and (names[0],) == strikes[-1].names:
            names.reverse()
        strikes += [Strike((of.hit(dice, name, ways.get(name, WAYS)[i:i + 1]),),
                           dice.uniform(*after_s)) for name in names]
    return strikes


def every_pair(of: Targets, seed: int) -> list[Strike]:
    """Return every pair of a system's processes in a drawn order, each killed, stopped or hung.

    A pair with the supervisor or the root comes in all combinations of ways, and others in one.
    """
    dice = random.Random(f"pairs {seed}")
    names = [name for name in of.mortal if name != POOL]  # one may replace the other
    lasting = tuple(way for way in WAYS if way != "SEGV")
    drawn = []
    for pair in combinations((*names, *of.paused), 2):
        each = [[(way,) for way in lasting] if name in names else [(PAUSE,)] for name in pair]
        combined = list(product(*each))
        if not {SUPERVISOR, ROOT_PROCESS} & set(pair):
            combined = [dice.choice(combined)]
        for ways in combined:
            hits = [of.hit(dice, name, way) for name, way in zip(pair, ways, strict=True)]
            dice.shuffle(hits)
            gap_s = 0.0 if dice.random() < 0.4 else dice.uniform(0.0, GAP_S)
            drawn.append(Strike(tuple(hits), gap_s=gap_s))
    dice.shuffle(drawn)
    return drawn


@dataclass(frozen=True, slots=True)
class Struck:
    """A strike that was carried out.

    Attributes:
        strike: The strike.
        back_s: Wall seconds from the first signal until all was back that was asked for; None if
            it was not in time.
        missing: What was not back.
    """

    strike: Strike
    back_s: float | None
    missing: str = ""

    def __str__(self) -> str:
        back = f"NOT BACK: {self.missing}" if self.back_s is None else (
            f"back in {self.back_s * 1e3:5.0f} ms")
        return f"{self.strike}  {back}"


class Chaos:
    """Carries out strikes on a run whose mission is under way.

    Args:
        run: The run.
        report: Is called with each strike that was carried out.

    Attributes:
        struck: What was carried out.
        resets: Emergency stops that were released.
    """

    def __init__(self, run: RealRun, report: Callable[[Struck], object] = lambda _: None) -> None:
        self.struck: list[Struck] = []
        self.resets = 0
        self._run = run
        self._report = report
        info = run.info
        self._rate = info.rate
        self._clock = Clock(info.origin_s, info.rate)
        self._read = 0
        self._has_ended = False
        self._decided = ""

    def carry_out(self, strikes: Iterable[Strike]) -> list[Strike]:
        """Strike while the run lasts; return what was left to be done."""
        strikes = list(strikes)
        for i, strike in enumerate(strikes):
            until = time.monotonic() + strike.after_s
            while time.monotonic() < until and not self.over():
                time.sleep(0.02)
            if self.over() or self.strike(strike) is None:
                return strikes[i:]
        return []

    def strike(self, strike: Strike, *, everything: bool = False) -> Struck | None:
        """Hit, and wait for the repair; return None if the run was over first.

        Args:
            strike: What is hit.
            everything: Whether the whole system has to be back, and not only the victims.
        """
        begun_s = time.monotonic()
        deadline = begun_s + BACK_WITHIN_S * len(strike.hits)
        before: dict[str, int] = {}
        missing = "a victim"
        while time.monotonic() < deadline:
            if self.over():
                return None
            if not before:
                there = self._pids()
                if set(strike.names) <= there.keys():
                    before, begun_s = there, time.monotonic()
                    self._send(strike, before)
            elif not (missing := ", ".join(hit.name for hit in strike.hits
                                           if not self._is_replaced(hit, before[hit.name]))):
                missing = self._missing() if everything else ""
                if not missing:
                    return self._note(Struck(strike, time.monotonic() - begun_s))
            time.sleep(0.005)
        return self._note(Struck(strike, None, missing))

    def over(self) -> bool:
        """Return whether the mission has ended, or the run."""
        new = self._run.story_from(self._read)
        whole = new[:new.rfind("\n") + 1]
        self._read += len(whole.encode())
        self._has_ended = self._has_ended or _ENDED.search(whole) is not None
        for decision in _DECISION.finditer(whole):
            self._decided = decision[1]
        return self._has_ended or self._run.process.poll() is not None

    def release(self) -> None:
        """Reset the emergency stop, as an operator does, when nothing else keeps the robot."""
        latched = f"({EMERGENCY_STOP})" in self._decided and " for " not in self._decided
        if latched and not self.over():
            self.resets += self._run.tool("reset", EMERGENCY_STOP).returncode == 0

    def _note(self, struck: Struck) -> Struck:
        self.struck.append(struck)
        self._report(struck)
        return struck

    def _send(self, strike: Strike, pids: dict[str, int]) -> None:
        """Send each signal when it is due, those included that let the paused go on."""
        due: list[tuple[float, str, int]] = []
        for i, hit in enumerate(strike.hits):
            at_s = i * strike.gap_s
            due.append((at_s, hit.name, SIGNALS["STOP" if hit.way == PAUSE else hit.way]))
            if hit.way == PAUSE:
                pause_s = hit.pause_s / (1.0 if hit.name == ROOT_PROCESS else self._rate)
                due.append((at_s + pause_s, hit.name, signal.SIGCONT))
        begun_s = time.monotonic()
        for at_s, name, number in sorted(due):
            time.sleep(max(0.0, begun_s + at_s - time.monotonic()))
            with contextlib.suppress(ProcessLookupError):
                os.kill(pids[name], number)

    def _pids(self) -> dict[str, int]:
        pids = {ROOT_PROCESS: self._run.process.pid}
        for process in sorted(find_processes(self._run.port), key=lambda p: p.incarnation):
            pids |= dict.fromkeys(process.names, process.pid)
        return pids

    def _is_replaced(self, hit: Hit, old: int) -> bool:
        new = self._pids().get(hit.name)
        if hit.way == PAUSE:
            return new == old and process_state(old) in "SRD"
        return new not in {None, old} and process_state(old) in "XZ"

    def _missing(self) -> str:
        """Return what is not as it has to be, "" if all nodes run and sent a heartbeat just now.

        The supervisor, which does not hear itself, shows by its table that it works.
        """
        since_s = self._clock.now() - 1.0
        table = json.loads(printed(self._run, "node", "list", "--json") or "[]")
        there, wrong = self._pids(), []
        for row in table:
            is_late = row["name"] != SUPERVISOR and row.get("heard_s", 0.0) < since_s
            if is_late or row["state"] != "running" or row["pid"] != there.get(row["name"]):
                wrong.append(f"{row['name']} {row['state']}, {row['pid']}")
        return ", ".join(wrong) if table else "no table from the supervisor"


def complaints(code: int, result: Mapping[str, Any], story: str, lights: tuple[str, ...] = ("",),
               ) -> list[str]:
    """Return what is wrong with a run that has ended; empty if all is as it has to be.

    Three records of lights are compared: the result, and both nodes' checkpoints. A light that was
    measured twice has two intensities, and one of the three has the other one.

    Args:
        code: Its exit code.
        result: What it printed with --json.
        story: And on stderr.
        lights: How the names of the lights begin that the mission passes.
    """
    if (code, result.get("mission"), result.get("safety")) != (0, "success", "safe"):
        return [f"exit code {code}, {result}"]  # and lights are missing
    wrong = [f"printed: {line}" for line in story.splitlines()
             if "UNSAFE" in line or "given up" in line]
    report = Path(result["report"])
    run_id = report.stem.removeprefix("inspection-")
    reported = {one["name"]: one["intensity_cd"] for one in result["lights"]
                if one["verdict"] != "not measured"}
    expected = {one["name"] for one in result["lights"] if one["name"].startswith(lights)}
    if reported.keys() != expected:
        wrong.append(f"lights: {sorted(reported)}, not {sorted(expected)}")
    for node, form in (("mission_manager", MISSION_STATE), ("osmosis_control", CONTROL_STATE)):
        newest = read(report.parent / "checkpoints", node, run_id).records[0]
        state: Any = form.decode(newest.version, newest.state)
        kept = state.lights if node == "mission_manager" else state.lights.measured
        if sorted((x.light, x.intensity_cd) for x in kept) != sorted(reported.items()):
            wrong.append(f"lights of {node}: {kept}, not {reported}")
    return wrong
