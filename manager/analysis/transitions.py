"""The arbiter's transition system, explored exhaustively.

What is explored is the arbiter itself (`Arbiter.step`), in two compositions:

* *one recovery with its module and the bus between them*: the module, as it is specified in
  `rampart.actors.recovery.module`, obeys, finishes, fails, dies and comes back at any moment. It
  shows that a module never holds its resources unless the arbiter knows that it may;
* *several recoveries together*, by what the arbiter knows: anything that modules can report may be
  reported at any moment. It shows that the arbiter never lets two hold the same resource.

In both, detection modules change at any moment, a message takes any time or is lost, and any
deadline may pass. Three reductions keep that finite and small;
`docs/explanation/arbitration.md` argues for each:

* *Time.* A deadline may pass whenever it runs. That is more than can happen, so what holds here
  holds in time.
* *Channels.* Commands and reports are states: the latest one counts, it is repeated, and no older
  one overtakes it. So a module may at any moment take note of what is wanted of it now, and the
  arbiter of how the module is now; a message that is lost or late is one not taken note of yet.
* *Recoveries.* Every property speaks of one recovery or of two, and one recovery touches another
  only by being in its way. So it is enough to explore every choice of two, while the rest of the
  world asks for any of them at any time, as far as the strategy ever does. Any larger number can
  be explored together as well; it takes longer and finds the same.
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
from rampart.manager.model.mechanisms import Contract, Mechanism, Mechanisms, RecoveryPhase
from rampart.manager.model.order import PartialOrder, Tree
from rampart.manager.strategies.arrangement import Arrangement
from rampart.manager.strategies.decision import Decision, Late

Steps = Iterator[tuple[str, "Situation"]]
Violations = dict[str, tuple[str, ...]]
"""Properties that fail, each with the shortest way there."""

_OVER = -1e9
_OLD, _CURRENT = 5, 10
_NUMBER = 100
_EXCUSE, _EXCUSED = "D_excuse", "F_excuse"
"""What excuses a latch, whatever that is in the system: detected, and the mechanism for it."""


class Module(msgspec.Struct, frozen=True):
    """A recovery module as it really is.

    Attributes:
        phase: What it does.
        current: It has taken note of the arbiter's present command.
        excused: It was given up on, and others no longer wait for it.
    """

    phase: RecoveryPhase = RecoveryPhase.IDLE
    current: bool = True
    excused: bool = False


class Situation(msgspec.Struct, frozen=True):
    """One state of the whole: the arbiter's, and each module's where modules are explored."""

    state: State
    modules: tuple[Module, ...]


class AsTold:
    """A strategy that runs what is asked for: the environment decides."""

    name = "as-told"
    patient = False
    rules: dict[int, str] = {1: "it is asked for"}

    def __init__(self, *, exclusive: bool) -> None:
        self.exclusive = exclusive

    def choose(self, active: tuple[str, ...], arrangement: Arrangement, late: Late  # noqa: ARG002
               ) -> Decision:
        """Run the recovery of every active mechanism; an excuse asks for nothing."""
        active = tuple(name for name in active if name != _EXCUSED)
        return Decision(active, 1, arrangement.demanded(active), active)

    def explain(self, decision: Decision, arrangement: Arrangement) -> Decision:  # noqa: ARG002
        """There is nothing to explain."""
        return decision


class Transitions:
    """The transition system for a few recoveries.

    Args:
        contracts: Of these recoveries.
        order: The RM order over them.
        asked: Sets of them that the strategy may ask for; the empty set is always among them.
        exclusive: The strategy runs one at a time.
        urgent: Those that must never wait: last resorts.
        with_modules: Explore the modules themselves; else anything that they can report.
        deaths: Modules may die and come back.
    """

    def __init__(self, contracts: Iterable[Contract], order: PartialOrder,
                 asked: Iterable[frozenset[str]], urgent: Iterable[str] = (), *,
                 exclusive: bool, with_modules: bool = False, deaths: bool = True) -> None:
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
        mechanisms = Mechanisms([Mechanism(f, d, n) for f, (d, n) in answers.items()],
                                list(self.contracts.values()))
        tree = Tree({f: None if f == f"F_{top}" else f"F_{top}" for f in answers})
        self.arbiter = Arbiter(Arrangement(mechanisms, tree, local), AsTold(exclusive=exclusive),
                               DetectionRules(1.0, 0.0, 0.0, 0.0))

    def initial(self) -> Situation:
        """Return the state in which all are idle and have been heard.

        Before that an arbiter adopts what an earlier one ordered; it is not explored.
        """
        return self._canonical(replace(self.arbiter.initial(0.0), oriented=True),
                               tuple(Module() for _ in self.names) if self.with_modules else ())

    def successors(self, now: Situation) -> Steps:
        """Yield everything that may happen next, in words, with the state that follows."""
        active = {t.name for t in now.state.detections if t.active}
        for asked in self.asked:
            changes = {f"D_{n}": n in asked for n in self.names
                       if (n in asked) != (f"D_{n}" in active)}
            if changes:
                yield (f"asked for: {', '.join(sorted(asked)) or 'nothing'}",
                       self._detect(now, changes))
        for t in now.state.detections:
            if t.name == _EXCUSE:
                yield ("the excuse ends" if t.active else "what excuses is found",
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
            if track.latched:
                yield f"{name} is reset", self._step(now, now.state, ResetAsked(name))

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
        yield f"the arbiter hears {name}", self._hear(
            now, name, module.phase, current=module.current)
        if module.phase is not RecoveryPhase.IDLE and self.deaths:
            yield f"{name} dies and comes back idle", self._with_module(
                now, index, Module(current=False))

    # -- single steps ---------------------------------------------------------------------------

    def _detect(self, now: Situation, changes: Mapping[str, bool]) -> Situation:
        """Return what follows when detection modules become active, or idle."""
        tracks = tuple(
            replace(t, active=changes[t.name], reported=changes[t.name], rises=2)
            if t.name in changes else t for t in now.state.detections)
        return self._step(now, replace(now.state, detections=tracks), Tick())

    def _hear(self, now: Situation, name: str, phase: RecoveryPhase, *, current: bool = True
              ) -> Situation:
        """Return what follows when the arbiter hears a module, on its present command or not."""
        return self._step(now, now.state, RecoveryHeard(
            name, phase is not RecoveryPhase.IDLE, phase, _CURRENT if current else _OLD))

    def pass_deadline(self, now: Situation, index: int) -> Situation:
        """Return what follows when the deadline of a recovery passes."""
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
        """Forget what makes no difference: numbers, times, words."""
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
        return Situation(replace(state, detections=detections, recoveries=recoveries,
                                 number=_NUMBER, decision=decision), modules)

    # -- properties -----------------------------------------------------------------------------

    def faults(self, now: Situation) -> Iterator[tuple[str, str]]:
        """Yield each property that fails in a state, and what is wrong."""
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
                yield "recovery-ends", f"{track.name} waits for ever"

    def _conflicts(self, now: Situation) -> Iterator[str]:
        """Yield in words who may hold what another one holds, or holds it unknown."""
        tracks = now.state.recoveries
        holding = [t for t in tracks if (t.wanted or t.letting_go) and not t.failure]
        for one, other in combinations(holding, 2):
            if self.arbiter.mechanisms.overlap(one.name, other.name):
                yield f"{one.name} and {other.name} may both hold what they claim"
        for track, module in zip(tracks, now.modules, strict=self.with_modules):
            holds = module.phase is not RecoveryPhase.IDLE and not module.excused
            if holds and not (track.wanted or track.letting_go):
                yield f"{track.name} holds on, and nobody knows"

    def _starts(self, now: Situation, waiting: int) -> bool:
        """Tell whether a recovery that waits starts once all deadlines of others have passed."""
        for index in range(len(self.names)):
            if index != waiting:
                now = self.pass_deadline(now, index)
        return now.state.recoveries[waiting].wanted \
            or self.names[waiting] not in now.state.decision.recoveries

    def cut_off(self, before: Situation, after: Situation) -> str:
        """Return which recovery is released half-way in a step, "" if none.

        Where modules die and come back unheard, the arbiter cannot know that one has begun anew;
        then it is the module that finishes first (`rampart.actors.recovery.module`).
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
    """Whether a recovery is at work that has to end."""
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
            if after not in came_from:
                came_from[after] = (now, event)
                waiting.append(after)
    return len(came_from), found
