"""What the tests of the manager share: the shipped system, and an arbiter with a clock to turn."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from functools import cache
from typing import Any, Self

import msgspec

from rampart import Command, Context, DecisionMade, RecoveryHeard, ResetAsked, Tick, systems
from rampart.actors.bus.topics import DIAGNOSTIC
from rampart.actors.detection.stub import StubDetection
from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics
from rampart.actors.recovery.stub import StubRecovery
from rampart.manager.actor import FtmManager
from rampart.manager.arbitration.arbiter import build_arbiter
from rampart.manager.arbitration.arbiter_state import ResetAnswered
from rampart.manager.arbitration.detection_track import DetectionHeard
from rampart.manager.model.mechanisms import RecoveryPhase
from rampart.manager.spec.specification import SystemSpec, parse_specification
from rampart.testing import VirtualSystem
from tests.osmosis_system import run_context
from tests.osmosis_system import shipped_system as paper

PAPER, FULL = ((systems.SHIPPED / name).read_text(encoding="utf-8")
               for name in ("paper.toml", "osmosis.toml"))
DMS = ("DM1", "DM2", "DM3", "DM4", "DM5", "DM6", "DM7")
RMS = ("RM1", "RM2", "RM3", "RM4", "RM5")


@cache
def full_system() -> SystemSpec:
    return parse_specification(FULL, "systems/osmosis.toml")


def edited(**changes: Any) -> SystemSpec:
    """The shipped system with rows and fields changed: `RM3=dict(deadline_s=1.0), strategy="x"`."""
    def rows(table):
        return tuple(msgspec.structs.replace(row, **changes.pop(row.name, {})) for row in table)

    spec = paper()
    spec = msgspec.structs.replace(
        spec, mechanisms=rows(spec.mechanisms), recoveries=rows(spec.recoveries))
    return msgspec.structs.replace(spec, **changes)


def closure(pairs: set[tuple[str, str]]) -> set[tuple[str, str]]:
    """Return all pairs that follow from these by transitivity, by brute force."""
    closed = set(pairs)
    while more := {(a, d) for a, b in closed for c, d in closed if b == c} - closed:
        closed |= more
    return closed


class Bench:
    """An arbiter, a clock that moves when told, and everything the arbiter has put out."""

    def __init__(self, spec: SystemSpec | None = None, *, oriented: bool = True) -> None:
        self.arbiter = build_arbiter(spec or paper())
        self.now = 0.0
        self.state = self.arbiter.initial(0.0)
        self.log = []
        if oriented:
            for dm in DMS:
                self.idle(dm)
            for rm in RMS:
                self.report(rm, RecoveryPhase.IDLE)
            self.log.clear()

    def send(self, event) -> list:
        self.state, outputs = self.arbiter.step(self.state, event, self.now)
        self.log.extend(outputs)
        return list(outputs)

    def active(self, dm: str, *nodes: str) -> list:
        return self.send(DetectionHeard(dm, True, f"{dm} says so", nodes, self.now))

    def idle(self, dm: str) -> list:
        return self.send(DetectionHeard(dm, False, "", (), self.now))

    def report(self, rm: str, phase: RecoveryPhase, decision: int | None = None) -> list:
        """Report as a module does that has obeyed its last command (or that decision)."""
        number = self.state.desired[rm].decision if decision is None else decision
        return self.send(RecoveryHeard(rm, phase is not RecoveryPhase.IDLE, phase, number))

    def reset(self, rm: str) -> ResetAnswered:
        return next(o for o in self.send(ResetAsked(rm, "the tower"))
                    if isinstance(o, ResetAnswered))

    def wait(self, seconds: float, *, hearing: tuple[str, ...] = DMS) -> list:
        """Let time pass in steps of 50 ms, while `hearing` repeat what they said last."""
        outputs = []
        for _ in range(round(seconds / 0.05)):
            self.now = round(self.now + 0.05, 6)
            outputs += self.send(Tick())
            for track in self.state.detections:
                if track.name in hearing:
                    outputs += self.send(DetectionHeard(
                        track.name, track.reported, track.reason, track.nodes, track.since_s))
        return outputs

    def play(self, script: str) -> Bench:
        """Play a timeline, step by step, and compare what follows of each step.

        A step is `DM4 node` (reports activity of nodes), `-DM4`, `RM3 done` (with `41`: of that
        decision), `wait 1.0` (`without DM1`: which is not heard), `reset RM1` or `refused RM1 why`.
        Behind it: `> +RM2 -RM3`, the commands of this step; `= RM2 (RM3)`, the orders then. What is
        known is checked by `latched:`, `active:`, `silent:`, `late:`; `rejected: RM3 words` looks
        for a reason of the last decision.
        """
        for step in filter(None, map(str.strip, script.replace("\n", ";").split(";"))):
            action, is_ordered, orders = step.partition("=")
            action, is_told, told = action.partition(">")
            outputs = self._act(*action.split())
            if is_told:
                found = [f"{'+' if on else '-'}{rm}" for rm, on in commands(outputs)]
                assert found == told.split(), step
            if is_ordered:
                assert self.orders == orders.strip(), step
        return self

    def _act(self, word: str, *rest: str) -> list:
        if word.startswith(("DM", "-DM")):
            return self.active(word, *rest) if word[0] == "D" else self.idle(word[1:])
        if word.startswith("RM"):
            return self.report(word, RecoveryPhase(rest[0]), *map(int, rest[1:]))
        if word == "wait":
            return self.wait(float(rest[0]), hearing=tuple(dm for dm in DMS if dm not in rest[2:]))
        if word in {"reset", "refused"}:
            answer = self.reset(rest[0])
            assert answer.granted == (word == "reset"), rest
            assert " ".join(rest[1:]) in answer.reason
        elif word == "rejected:":
            why = dict(self.decisions[-1].decision.rejected)[rest[0]]
            assert " ".join(rest[1:]) in why, why
        else:
            assert set(getattr(self.state, word.rstrip(":"))) == set(rest), (word, rest)
        return []

    @property
    def orders(self) -> str:
        """Recoveries under orders, draining ones in brackets."""
        return " ".join(f"({t.name})" if t.draining else t.name
                        for t in self.state.recoveries if t.wanted)

    @property
    def decisions(self) -> list[DecisionMade]:
        return [msgspec.structs.replace(output, decision=self.arbiter.explain(output))
                for output in self.log if isinstance(output, DecisionMade)]


def commands(outputs: list) -> list[tuple[str, bool]]:
    return [(o.recovery, o.activate) for o in outputs if isinstance(o, Command)]


class Managed(VirtualSystem):
    """The running manager between modules that do what they are told, and all that it says."""

    def __init__(self, spec: SystemSpec | None = None,
                 manager: Callable[[Context], FtmManager] = FtmManager, **known: Any) -> None:
        super().__init__(run_context(system=spec or paper(), **known))
        self._manager = manager
        self.decisions, self.respawns, self.problems, self.statuses = map(self.hear, (
            topics.DECISION, topics.RESPAWN, DIAGNOSTIC, topics.MANAGER_STATUS))

    async def __aenter__(self) -> Self:
        """Start everything, and wait until all is known and well."""
        await super().__aenter__()
        self.start_manager()
        for detection in self.run.system.detections:
            self.start(detection.name, StubDetection)
        for recovery in self.run.system.recoveries:
            self.start(recovery.name, StubRecovery, takes_s=0.02,
                       ends="done" if recovery.kind.repairs else "degraded")
        await asyncio.sleep(1.0)
        return self

    def start_manager(self) -> None:
        self.start("ftm_manager", self._manager)

    def detect(self, *active: str) -> None:
        """Have exactly these detection modules be active."""
        for detection in self.run.system.detections:
            self.say(topics.STUB_TRIGGER, fm.StubTrigger(
                detection.name, detection.name in active, "played"))

    async def reset(self, recovery: str) -> None:
        self.say(topics.RESET, fm.Reset(recovery, "operator"))
        await self.settle()

    @property
    def status(self) -> fm.ManagerStatus:
        """What the manager said last."""
        return self.statuses[-1].message

    @property
    def taken(self) -> list[tuple[tuple[str, ...], int, tuple[str, ...]]]:
        """Active mechanisms, rule and recoveries of each decision."""
        return [(d.message.active, d.message.rule, d.message.recoveries) for d in self.decisions]
