"""Chaos in pairs: hits two processes of a run at once, and sees that everything comes back.

The plan is pure and seeded: every pair of the processes once, each of the two killed, stopped or
wedged as drawn, at the same moment or up to `GAP_S` apart. A pair with a guard (supervisor, root)
comes in all combinations of ways. Two processes are only stopped for a moment (`chaos` says why):
the world, and the root, whose end is the run's.

Everything is back when both have been replaced, the supervisor's table has all nodes running in
the processes that /proc shows, and each of them has been heard since. Nothing waits for the
supervisor's word alone.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import random
import re
import signal
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from itertools import combinations, product
from typing import Any

from rampart.actors.ftm import topics
from rampart.actors.ftm.messages import NodeState, NodeTable
from rampart.actors.runtime.actor import HEARTBEAT
from rampart.actors.runtime.run_plan import SUPERVISOR
from rampart.actors.supervision.kill_node import SIGNALS
from rampart.actors.supervision.process_title import find_processes, process_state
from rampart.actors.supervision.root import POOL
from rampart.cli.output import UsageError
from rampart.cli.session import connect
from rampart.testing import RealRun
from tests.whole.chaos import WORLD_PAUSE_S, Targets, tells_end

LAUNCHER = "root"
WAYS = ("KILL", "STOP", "WEDGE")
PAUSE = "PAUSE"
GUARDS = (SUPERVISOR, LAUNCHER)
GAP_S = 0.4
"""The second of a pair is hit at once, or up to so many wall seconds later."""

LAUNCHER_PAUSE_S = (0.3, 1.5)
BACK_WITHIN_S = 20.0
"""Wall seconds after which it counts as failed that everything is back; the machine may be busy."""

_DECISION = re.compile(r"\] decision \d+: (.*)")
_LATCHED = "RM1"
"""What a decision names when nothing is active any more and the emergency stop is not released."""

_LISTEN_S = 1.5
"""So long one session listens: who comes back later does not dial it."""


@dataclass(frozen=True, slots=True)
class Pair:
    """Two processes to be hit, how, and the second one how much later (wall seconds)."""

    index: int
    names: tuple[str, str]
    ways: tuple[str, str]
    gap_s: float
    pause_s: float

    def __str__(self) -> str:
        (a, b), (how, too) = self.names, self.ways
        return f"{how:<5} {a:<16} {too:<5} {b:<16} {self.gap_s * 1e3:3.0f} ms apart"


def plan_pairs(of: Targets, seed: int) -> list[Pair]:
    """Return every pair of a system's processes, in the order of its dice."""
    dice = random.Random(f"pairs {seed}")
    mortal = [name for name in of.mortal if name != POOL]  # one may become the other's heir
    everybody = (*mortal, *of.world, LAUNCHER)
    paused = {*of.world, LAUNCHER}
    drawn = []
    for pair in combinations(everybody, 2):
        both = [[PAUSE] if name in paused else list(WAYS) for name in pair]
        ways = list(product(*both))
        if not set(pair) & set(GUARDS):
            ways = [dice.choice(ways)]
        for way in ways:
            names, how = (pair, way) if dice.random() < 0.5 else (pair[::-1], way[::-1])
            gap_s = 0.0 if dice.random() < 0.4 else dice.uniform(0.0, GAP_S)
            drawn.append(Pair(0, names, how, gap_s, dice.uniform(*LAUNCHER_PAUSE_S)))
    dice.shuffle(drawn)
    return [replace(pair, index=index) for index, pair in enumerate(drawn)]


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of a pair.

    Attributes:
        pair: The pair.
        replaced_s: Wall seconds from the first signal until both had been replaced.
        back_s: And until everything was back; None if it was not within `BACK_WITHIN_S`.
        others: Who was replaced besides.
        missing: What was not back.
        story: What the run told meanwhile, if it is not back.
    """

    pair: Pair
    replaced_s: float | None
    back_s: float | None
    others: tuple[str, ...]
    missing: str = ""
    story: str = ""

    def __str__(self) -> str:
        back = f"NOT BACK: {self.missing}" if self.back_s is None else (
            f"back in {self.back_s * 1e3:5.0f} ms")
        others = f"  and {', '.join(self.others)}" if self.others else ""
        return f"{self.pair}  {back}{others}"

    @property
    def record(self) -> dict[str, Any]:
        """Return it as plain data."""
        data = asdict(self)
        return {**data.pop("pair"), **data}


class PairChaos:
    """Carries out pairs on a run whose mission is under way."""

    def __init__(self, run: RealRun, world: Sequence[str]) -> None:
        self._run = run
        self._world = world
        self._rate = run.info.rate
        self._read = 0
        self._ended = False
        self._decided = ""
        self.resets = 0

    def strike(self, pair: Pair) -> Outcome | None:
        """Hit a pair and wait until everything is back; None if the mission was over first."""
        told = self._read
        before = self._pids()
        old = {name: before.get(name, 0) for name in pair.names}
        begun_s = time.monotonic()
        self._hit(pair, old)
        replaced_s, missing = None, "a process that had failed before"
        while time.monotonic() - begun_s < BACK_WITHIN_S:
            if self.over():
                return None
            if all(self._is_replaced(name, old[name]) for name in pair.names):
                replaced_s = replaced_s or time.monotonic() - begun_s
                missing = asyncio.run(self._missing())
                if not missing:
                    return Outcome(pair, replaced_s, time.monotonic() - begun_s,
                                   self._others(pair, before))
            else:
                missing = "not replaced: " + ", ".join(
                    name for name in pair.names if not self._is_replaced(name, old[name]))
                time.sleep(0.01)
        return Outcome(pair, replaced_s, None, self._others(pair, before), missing,
                       self._run.story_from(told))

    def over(self) -> bool:
        """Whether the mission has ended, or the run."""
        new = self._run.story_from(self._read)
        whole = new.rpartition("\n")[0]
        self._read += len(whole.encode())
        self._ended = self._ended or tells_end(whole)
        for decision in _DECISION.finditer(whole):
            self._decided = decision[1]
        return self._ended or self._run.process.poll() is not None

    def release(self) -> None:
        """Do what an operator does when all is well again and the robot still stands: reset it."""
        if not self.over() and f"({_LATCHED})" in self._decided and " for " not in self._decided:
            self.resets += self._run.tool("reset", _LATCHED).returncode == 0

    def _hit(self, pair: Pair, old: dict[str, int]) -> None:
        """Send the signals, those that let the paused go on included, each when it is due."""
        due: list[tuple[float, str, int]] = []
        for i, (name, way) in enumerate(zip(pair.names, pair.ways, strict=True)):
            at_s = i * pair.gap_s
            due.append((at_s, name, signal.SIGSTOP if way == PAUSE else SIGNALS[way]))
            if way == PAUSE:
                for_s = pair.pause_s if name == LAUNCHER else WORLD_PAUSE_S / self._rate
                due.append((at_s + for_s, name, signal.SIGCONT))
        begun_s = time.monotonic()
        for at_s, name, number in sorted(due):
            time.sleep(max(0.0, begun_s + at_s - time.monotonic()))
            if old[name]:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(old[name], number)

    def _pids(self) -> dict[str, int]:
        pids = {LAUNCHER: self._run.process.pid}
        for process in sorted(find_processes(self._run.port), key=lambda p: p.incarnation):
            for name in process.names:
                pids[name] = process.pid
        return pids

    def _is_replaced(self, name: str, old: int) -> bool:
        new = self._pids().get(name)
        if name == LAUNCHER or name in self._world:
            return new == old and process_state(old) in "SRD"
        return bool(new) and new != old and process_state(old) in "XZ"

    def _others(self, pair: Pair, before: dict[str, int]) -> tuple[str, ...]:
        after = self._pids()
        return tuple(sorted(name for name, pid in before.items()
                            if name not in pair.names and after.get(name) != pid))

    async def _missing(self) -> str:
        """Return what is not as it has to be, "" if all nodes run and were heard just now."""
        tables: list[NodeTable] = []
        heard: dict[str, int] = {}
        missing = "no table from the supervisor"
        try:
            async with connect(self._run.port) as session:
                session.listen(topics.NODES, topics.NODES.at(),
                               lambda _key, _header, table: tables.append(table))
                session.listen(HEARTBEAT, HEARTBEAT.pattern, lambda _key, header, beat: (
                    heard.update({header.source: beat.pid})))
                deadline = time.monotonic() + session.real_s(_LISTEN_S)
                while missing and time.monotonic() < deadline and not self.over():
                    await asyncio.sleep(0.02)
                    if tables:
                        missing = self._compared(tables[-1], heard)
        except UsageError as error:  # the launcher does not answer
            await asyncio.sleep(0.1)
            return str(error)
        return missing

    def _compared(self, table: NodeTable, heard: dict[str, int]) -> str:
        there = self._pids()
        wrong = [f"{row.name} {row.state.value}" for row in table.nodes
                 if row.state is not NodeState.RUNNING]
        wrong += [f"{row.name} has another pid" for row in table.nodes
                  if there.get(row.name) != row.pid]
        wrong += [f"{row.name} not heard" for row in table.nodes
                  if heard.get(row.name) != row.pid]
        return ", ".join(wrong)
