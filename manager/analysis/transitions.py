"""Explores the arbiter's transition system exhaustively.

The exploration runs the arbiter itself (`Arbiter.step`), in two compositions:

* *One recovery with its module and the bus between them.* The module obeys, finishes, fails, dies
  and comes back at any moment, as `rampart.actors.recovery.module` specifies. This shows that a
  module never holds its resources unless the arbiter knows that it may.
* *Several recoveries together.* A module may report anything at any moment. This shows that the
  arbiter never lets two recoveries hold the same resource.

In both, detection modules change at any moment, a message takes any time or is lost, and any
deadline may pass. Three reductions keep the exploration finite and small;
`docs/explanation/arbitration.md` argues for each:

* *Time.* A deadline may pass whenever it runs. This covers more executions than are possible, so a
  property that holds here also holds with time.
* *Channels.* Commands and reports are states: they are repeated, and the newest one counts. So a
  module may read its present command at any moment, and the arbiter the present state of a module.
  A lost or late message is one that has not been read yet.
* *Recoveries.* Every property concerns one recovery or two, and one recovery influences another
  only by blocking it. So every pair is explored alone, while the environment asks for any of them
  at any moment, as far as the strategy can. Larger groups take longer and give the same verdicts.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from itertools import combinations

import msgspec
from msgspec.structs import replace

from rampart.manager.arbitration.arbiter import Arbiter
from rampart.manager.arbitration.arbiter_state import (
    LONG_AGO_S,
    Command,
    RecoveryHeard,
    RecoveryTrack,
    ResetAsked,
    State,
    Tick,
)
from rampart.manager.arbitration.detection_track import DetectionRules, DetectionTrack
from rampart.manager.model.mechanisms import Clears, Contract, Mechanism, Mechanisms, RecoveryPhase
from rampart.manager.model.order import PartialOrder, Tree
from rampart.manager.strategies.arrangement import Arrangement
from rampart.manager.strategies.decision import Decision, Late

Steps = Iterator[tuple[str, "Situation"]]
Violations = dict[str, tuple[str, ...]]
"""Properties that fail, each with the shortest trace to a violation."""

_OVER = -1e9
_OLD, _CURRENT = 5, 10
_NUMBER = 100
_IS_RESET = " is reset"
_EXCUSE, _EXCUSED = "D_excuse", "F_excuse"
"""The detection module and the mechanism that stand for whatever excuses a latch."""


class Module(msgspec.Struct, frozen=True):
    """The true state of a recovery module.

    Attributes:
        phase: What it does.
        current: It has read the arbiter's present command.
        excused: The arbiter has given it up, and others no longer wait for it.
    """

    phase: RecoveryPhase = RecoveryPhase.IDLE
    current: bool = True
    excused: bool = False


class Situation(msgspec.Struct, frozen=True):
    """One state of the composition: the arbiter, and the modules where these are explored."""

    state: State
    modules: tuple[Module, ...]


class AsAsked:
    """A strategy that runs what the environment asks for."""

    name = "as-asked"
    patient = False
    rules: dict[int, str] = {1: "it is asked for"}

    def __init__(self, *, exclusive: bool) -> None:
        self.exclusive = exclusive

    def choose(self, active: tuple[str, ...], arrangement: Arrangement, late: Late  # noqa: ARG002
               ) -> Decision:
        """Run the recovery of every active mechanism but the excuse."""
        active = tuple(name for name in active if name != _EXCUSED)
        return Decision(active, 1, arrangement.demanded(active), active)

    def explain(self, decision: Decision, arrangement: Arrangement) -> Decision:  # noqa: ARG002
        """Return the decision as it is."""
        return decision


class Transitions:
    """The transition system for a few recoveries.

    Args:
        contracts: Contracts of these recoveries.
        order: The RM order over them.
        asked: Sets of recoveries that the strategy may ask for; the empty set is always added.
        exclusive: The strategy runs one recovery at a time.
        urgent: Last resorts, which must never wait.
        clears: What ends the mechanism of each recovery.
        with_modules: Explore the modules themselves; else modules may report anything.
        deaths: Modules may die and come back.
    """

    def __init__(self, contracts: Iterable[Contract], order: PartialOrder,
                 asked: Iterable[frozenset[str]], urgent: Iterable[str] = (), *,
                 exclusive: bool, clears: Clears = Clears.BY_ITSELF, with_modules: bool = False,
                 deaths: bool = True) -> None:
        inside = {c.name: c for c in contracts}
        self.contracts = {n: replace(c, needs=frozenset(), escalate_to=(
            c.escalate_to if c.escalate_to in inside else ""), excused_by=(
            frozenset({_EXCUSE}) if c.excused_by else frozenset())) for n, c in inside.items()}
        self.names = tuple(self.contracts)
        self.asked = sorted({frozenset(), *asked}, key=lambda s: (len(s), sorted(s)))
        self.urgent = frozenset(urgent)
        self.exclusive = exclusive
        self.with_modules = with_modules
        self.deaths = deaths
        local = PartialOrder(self.names, {
            name: [o for o in self.names if order.is_above(name, o)] for name in self.names})
        top = local.names[0]
        answers = {f"F_{n}": (f"D_{n}", n) for n in self.names}
        if any(c.excused_by for c in self.contracts.values()):
            answers[_EXCUSED] = _EXCUSE, top
        mechanisms = Mechanisms([Mechanism(f, d, n, clears=(
            clears if f != _EXCUSED else Clears.BY_ITSELF)) for f, (d, n) in answers.items()],
                                list(self.contracts.values()))
        tree = Tree({f: None if f == f"F_{top}" else f"F_{top}" for f in answers})
        self.arbiter = Arbiter(Arrangement(mechanisms, tree, local), AsAsked(exclusive=exclusive),
                               DetectionRules(1.0, 0.0, 0.0, 0.0))

    def initial(self) -> Situation:
        """Return the state in which every module has reported that it is idle.

        Until then an arbiter adopts running recoveries; that phase is not explored.
        """
        return self._canonical(replace(self.arbiter.initial(0.0), oriented=True),
                               tuple(Module() for _ in self.names) if self.with_modules else ())

    def successors(self, now: Situation) -> Steps:
        """Yield every possible next event in words, with the state that follows."""
        active = {t.name for t in now.state.detections if t.active}
        for asked in self.asked:
            changes = {f"D_{n}": n in asked for n in self.names
                       if (n in asked) != (f"D_{n}" in active)}
            if changes:
                yield (f"asked for: {', '.join(sorted(asked)) or 'nothing'}",
                       self._detect(now, changes))
        for t in now.state.detections:
            if t.name == _EXCUSE:
                yield ("the excuse ends" if t.active else "an excuse is detected",
                       self._detect(now, {_EXCUSE: not t.active}))
        for index, name in enumerate(self.names):
            if f"D_{name}" in active and self.contracts[name].kind.repairs:
                yield f"{name}'s cause comes back", self._detect(now, {f"D_{name}": True})
            yield from self._module_steps(now, index, name) if self.with_modules \
                else self._reports(now, index, name)
            track = now.state.recoveries[index]
            runs = track.letting_go or (track.wanted and not track.failure)
            if runs and track.ordered_s == 0.0:
                yield f"{name}'s deadline passes", self.pass_deadline(now, index)
            if name in now.state.latched:
                yield f"{name}{_IS_RESET}", self._step(now, now.state, ResetAsked(name))

    def _reports(self, now: Situation, index: int, name: str) -> Steps:
        """Yield every report that a module could send."""
        track = now.state.recoveries[index]
        if track.wanted:
            for phase in (RecoveryPhase.ACTING, RecoveryPhase.DONE, RecoveryPhase.FAILED):
                if not track.acknowledged or track.phase is not phase:
                    yield f"{name} reports {phase}", self._hear(now, name, phase)
            if track.acknowledged and self.deaths:
                yield f"{name} reports idle, it was respawned", self._hear(
                    now, name, RecoveryPhase.IDLE, current=False)
        elif track.letting_go:
            yield f"{name} reports that it has let go", self._hear(now, name, RecoveryPhase.IDLE)

    def _module_steps(self, now: Situation, index: int, name: str) -> Steps:
        module, track = now.modules[index], now.state.recoveries[index]
        acting = module.phase is RecoveryPhase.ACTING
        if not module.current and track.wanted:
            yield f"{name} obeys", self._with_module(now, index, Module(RecoveryPhase.ACTING))
        elif not module.current and not acting:
            yield f"{name} lets go", self._with_module(now, index, Module())
        if acting:
            for phase, words in ((RecoveryPhase.DONE, "is done"), (RecoveryPhase.FAILED, "fails")):
                yield f"{name} {words}", self._with_module(
                    now, index, replace(module, phase=phase))
        yield f"the arbiter receives {name}'s report", self._hear(
            now, name, module.phase, current=module.current)
        if module.phase is not RecoveryPhase.IDLE and self.deaths:
            yield f"{name} dies and comes back idle", self._with_module(
                now, index, Module(current=False))

    # -- single steps ---------------------------------------------------------------------------

    def _detect(self, now: Situation, changes: Mapping[str, bool]) -> Situation:
        """Return the state after detection modules become active or idle."""
        tracks = tuple(
            replace(t, active=changes[t.name], reported=changes[t.name], rises=2)
            if t.name in changes else t for t in now.state.detections)
        return self._step(now, replace(now.state, detections=tracks), Tick())

    def _hear(self, now: Situation, name: str, phase: RecoveryPhase, *, current: bool = True
              ) -> Situation:
        """Return the state after a report, on the present command or on an older one."""
        return self._step(now, now.state, RecoveryHeard(
            name, phase is not RecoveryPhase.IDLE, phase, _CURRENT if current else _OLD))

    def pass_deadline(self, now: Situation, index: int) -> Situation:
        """Return the state after the deadline of a recovery passes."""
        tracks = list(now.state.recoveries)
        tracks[index] = replace(tracks[index], ordered_s=_OVER)
        return self._step(now, replace(now.state, recoveries=tuple(tracks)), Tick())

    def _with_module(self, now: Situation, index: int, module: Module) -> Situation:
        excused = now.modules[index].excused and module.phase is not RecoveryPhase.IDLE
        modules = list(now.modules)
        modules[index] = replace(module, excused=excused)
        return Situation(now.state, tuple(modules))

    def _step(self, now: Situation, state: State, event: RecoveryHeard | ResetAsked | Tick
              ) -> Situation:
        after, _ = self.arbiter.step(state, event, 0.0)
        modules = []
        for was, is_, module in zip(now.state.recoveries, after.recoveries, now.modules,
                                    strict=self.with_modules):
            current = module.current and is_.command == was.command
            given_up = (was.wanted or was.letting_go) and not is_.wanted and not is_.letting_go
            excused = module.excused or given_up or bool(is_.failure)
            modules.append(Module(
                module.phase, current, excused and module.phase is not RecoveryPhase.IDLE))
        return self._canonical(after, tuple(modules))

    def _canonical(self, state: State, modules: tuple[Module, ...]) -> Situation:
        """Drop what makes no difference: numbers, times, reasons."""
        rises = {t.name: t.rises for t in state.detections if t.active}
        detections = tuple(DetectionTrack(
            t.name, 0.0, ever_heard=True, reported=t.active, active=t.active, rises=1)
            for t in state.detections)
        recoveries = tuple(RecoveryTrack(
            Command(t.name, t.wanted, _CURRENT),
            ordered_s=_OVER if t.ordered_s < 0 and t.unfinished else 0.0,
            cause=frozenset((d, 1) for d, r in t.cause
                            if rises.get(d) == r and self.contracts[t.name].kind.repairs),
            heard=True, phase=t.phase if t.acknowledged else RecoveryPhase.IDLE,
            acknowledged=t.acknowledged, draining=t.draining, letting_go=t.letting_go,
            latched=t.latched, latched_s=0.0 if t.latched else LONG_AGO_S,
            failure="failed" if t.failure else "",
            failed_for=tuple(n for n in t.failed_for if f"D_{n[2:]}" in rises))
            for t in state.recoveries)
        decision = replace(state.decision, rejected=tuple(
            (name, "") for name, _ in state.decision.rejected))
        held = tuple(replace(h, since_s=0.0, seen_s=0.0) for h in state.held)
        return Situation(replace(state, detections=detections, recoveries=recoveries, held=held,
                                 number=_NUMBER, decision=decision), modules)

    # -- properties -----------------------------------------------------------------------------

    def faults(self, now: Situation) -> Iterator[tuple[str, str]]:
        """Yield each property that fails in a state, and how."""
        for problem in self._conflicts(now):
            yield "no-conflicting-claims", problem
        in_force = [t.name for t in now.state.recoveries if t.wanted and not t.draining]
        if self.exclusive and len(in_force) > 1:
            yield "one-decision", f"{' and '.join(in_force)} are both in force"
        for index, track in enumerate(now.state.recoveries):
            waits = track.name in now.state.decision.recoveries and not track.wanted
            if waits and track.name in self.urgent:
                yield "emergency-stop-at-once", f"{track.name} was decided on and has to wait"
            if _is_due(track) and not track.latched and _is_due(
                    self.pass_deadline(now, index).state.recoveries[index]):
                yield "recovery-ends", f"{track.name}'s deadline passes and nothing follows"
            if waits and not self._starts(now, index):
                yield "recovery-ends", f"{track.name} waits forever"

    def _conflicts(self, now: Situation) -> Iterator[str]:
        """Yield in words two recoveries that may hold one resource, or one that holds on unknown.

        A recovery that has failed is exempt: its successor must not wait.
        """
        tracks = now.state.recoveries
        holding = [t for t in tracks if (t.wanted or t.letting_go) and not t.failure]
        for one, other in combinations(holding, 2):
            if self.arbiter.mechanisms.overlap(one.name, other.name):
                yield f"{one.name} and {other.name} may both hold what they claim"
        for track, module in zip(tracks, now.modules, strict=self.with_modules):
            holds = module.phase is not RecoveryPhase.IDLE and not module.excused
            if holds and not (track.wanted or track.letting_go):
                yield f"{track.name} holds its claims, and the arbiter does not know"

    def _starts(self, now: Situation, waiting: int) -> bool:
        """Return whether a waiting recovery starts once the deadlines of all others have passed."""
        for index in range(len(self.names)):
            if index != waiting:
                now = self.pass_deadline(now, index)
        return now.state.recoveries[waiting].wanted \
            or self.names[waiting] not in now.state.decision.recoveries

    def cleared(self, before: Situation, event: str, after: Situation) -> str:
        """Return the mechanism that a step clears although it must not, "" if none."""
        contents = self.arbiter.mechanisms
        detected = contents.detected_by(t.name for t in after.state.detections if t.active)
        for name in set(before.state.active).difference(after.state.active):
            clears = contents.by_name[name].clears
            is_reset = event in {f"{r}{_IS_RESET}" for r in contents.recover[name]}
            if clears is Clears.NEVER or (clears is Clears.BY_OPERATOR and (
                    name in detected or not is_reset)):
                return name
        return ""

    def cut_off(self, before: Situation, after: Situation) -> str:
        """Return the recovery that a step releases half-way, "" if none.

        Where a module may die and come back unnoticed, the arbiter cannot know that it has started
        again. There the module itself finishes first (`rampart.actors.recovery.module`).
        """
        if self.deaths:
            return ""
        for was, is_, module in zip(before.state.recoveries, after.state.recoveries,
                                    before.modules, strict=self.with_modules):
            if was.wanted and not is_.wanted and module.current and not is_.failure \
                    and not was.failure and module.phase is RecoveryPhase.ACTING \
                    and not self.contracts[was.name].interruptible:
                return was.name
        return ""


def _is_due(track: RecoveryTrack) -> bool:
    """Return whether a recovery acts, and its deadline has to end that."""
    return track.unfinished and not track.failure


def explore(system: Transitions) -> tuple[int, Violations]:
    """Visit every reachable state, breadth first.

    Returns:
        How many states there are, and for each property that fails the shortest trace.
    """
    start = system.initial()
    came_from: dict[Situation, tuple[Situation, str] | None] = {start: None}
    found: Violations = {}
    waiting = deque([start])

    def trace(end: Situation, last: str) -> tuple[str, ...]:
        steps = [last]
        while (step := came_from[end]) is not None:
            end, event = step
            steps.append(event)
        return tuple(reversed(steps))

    while waiting:
        now = waiting.popleft()
        for name, problem in system.faults(now):
            if name not in found:
                found[name] = trace(now, problem)
        for event, after in system.successors(now):
            victim = system.cut_off(now, after)
            if victim and "none-cut-off" not in found:
                found["none-cut-off"] = (*trace(now, event), f"{victim} is released half-way")
            cleared = system.cleared(now, event, after)
            if cleared and "cleared-as-specified" not in found:
                found["cleared-as-specified"] = (*trace(now, event), f"{cleared} is cleared")
            if after not in came_from:
                came_from[after] = (now, event)
                waiting.append(after)
    return len(came_from), found
