"""The arbiter: from what detection and recovery modules report to what recovery modules do.

A pure state machine, `step(state, input, now) -> (state, outputs)`: it reads no clock, sends
nothing, and its state is immutable, so a timeline can be tested as one and all its reachable
states can be explored. The strategy decides *which* recovery; the arbiter sees to *how*:

* Exactly one recovery runs. Before one is activated, every other is released.
* None is cut off. One that is not interruptible and is acting, or may be because the order is
  still on its way, is not released but *drains*: it stays under orders until it reports that it
  is done, degraded or idle. What comes next waits for it, with one exception: a safer recovery
  that shares no claim with it starts at once. So an emergency stop never waits for a respawn.
* A recovery whose cause has cleared is released, and hands control back. A latched one stays
  until it is reset; only a safer one takes its place meanwhile. A reset is refused while the
  cause persists.
* A recovery that fails, or is not done by its deadline, is followed by the one it escalates to,
  else by that of the mechanism above. A repair also fails if it is done but its cause persists.
  One that is late but still acting is let be as long as it is in nobody's way: late is better
  than never.
* An arbiter that starts while recoveries are activated, because the one before it was killed,
  adopts them, and releases none before it has heard every module (or has waited long enough).

**The trap.** Safety-first runs the recovery of the dominating mechanism, and only that. When a
control node dies, its command goes stale as well: if DM2 is active before RM3 was started, FTM2
dominates FTM4 and RM2 runs. The robot stands, safely, and that is all that ever happens: RM3,
dominated, is not started, so the node stays dead, so the command stays stale, so FTM2 stays
active. This is the paper's strategy to the letter, not an error of the arbiter, which does what
it can: an RM3 that was started first drains, and its success clears both causes. It takes another
strategy to walk out of the trap.
"""

from __future__ import annotations

from collections.abc import Iterable

import msgspec

from manager import detection_track, recovery_track
from manager.decision import NOTHING_ACTIVE, Decision, Strategy
from manager.detection_track import DetectionRules, DetectionTrack
from manager.escalation import escalate
from manager.mechanisms import Mechanisms
from manager.order import PartialOrder, Tree
from manager.recovery_track import Command, Phase, RecoveryTrack
from manager.schema import SystemSpec
from manager.strategies import find_strategy


class DetectionHeard(msgspec.Struct, frozen=True, tag=True):
    """Input: a report of a detection module; `since_s` is when it took that state."""

    detection: str
    active: bool
    reason: str = ""
    nodes: tuple[str, ...] = ()
    since_s: float = 0.0


class DetectionRestarted(msgspec.Struct, frozen=True, tag=True):
    """Input: a detection module's process has died and is being respawned."""

    detection: str


class RecoveryHeard(msgspec.Struct, frozen=True, tag=True):
    """Input: a report of a recovery module, for the decision it last obeyed."""

    recovery: str
    activated: bool
    phase: Phase
    decision: int
    reason: str = ""


class ResetAsked(msgspec.Struct, frozen=True, tag=True):
    """Input: somebody asks to release a latched recovery."""

    recovery: str
    by: str = ""


class Tick(msgspec.Struct, frozen=True, tag=True):
    """Input: nothing but time has passed."""


Input = DetectionHeard | DetectionRestarted | RecoveryHeard | ResetAsked | Tick


class DecisionMade(msgspec.Struct, frozen=True, tag=True):
    """Output: a decision with its certificate, as it is carried out.

    Attributes:
        number: Counts up; commands refer to it.
        decision: The strategy's, but `recoveries` are those that the arbiter takes after
            escalation and latching, and `rejected` says so.
        detected_s: When the youngest of its causes was detected.
    """

    number: int
    decision: Decision
    detected_s: float


class ResetAnswered(msgspec.Struct, frozen=True, tag=True):
    """Output: a reset was granted, or refused for a reason."""

    recovery: str
    granted: bool
    reason: str


Output = Command | DecisionMade | ResetAnswered


class State(msgspec.Struct, frozen=True):
    """Everything the arbiter knows.

    Attributes:
        detections: One track for each detection module, in the sequence of the registry.
        recoveries: One track for each recovery module, likewise.
        number: Of the last decision.
        decision: The last decision, as carried out.
        started_s: When the arbiter started.
        oriented: It has heard everybody, or has waited long enough; adoption is over.
    """

    detections: tuple[DetectionTrack, ...]
    recoveries: tuple[RecoveryTrack, ...]
    number: int
    decision: Decision
    started_s: float
    oriented: bool = False

    @property
    def desired(self) -> dict[str, Command]:
        """What every recovery module is to do; repeat it until it is obeyed, and after."""
        return {track.name: track.command for track in self.recoveries}

    @property
    def active(self) -> tuple[str, ...]:
        """Names of the active mechanisms."""
        return self.decision.active

    @property
    def silent(self) -> tuple[str, ...]:
        """Names of the detection modules that count as active because they are silent."""
        return tuple(track.name for track in self.detections if track.silent)

    @property
    def activated(self) -> tuple[str, ...]:
        """Names of the recovery modules that are under orders, draining ones included."""
        return tuple(track.name for track in self.recoveries if track.wanted)

    @property
    def draining(self) -> tuple[str, ...]:
        """Names of the recovery modules that are superseded and finishing their action."""
        return tuple(track.name for track in self.recoveries if track.draining)

    @property
    def latched(self) -> tuple[str, ...]:
        """Names of the recovery modules that stay until they are reset."""
        return tuple(track.name for track in self.recoveries if track.latched)


class Arbiter:
    """The rules; all that changes is in `State`.

    Args:
        mechanisms: Registry of mechanisms and recovery contracts.
        tree: The FTMTree.
        order: The RM order.
        strategy: The policy.
        rules: For belief in detection modules.
    """

    def __init__(self, mechanisms: Mechanisms, tree: Tree, order: PartialOrder,
                 strategy: Strategy, rules: DetectionRules) -> None:
        self.mechanisms = mechanisms
        self.tree = tree
        self.order = order
        self.strategy = strategy
        self.rules = rules
        self._detection = {name: i for i, name in enumerate(mechanisms.detections)}
        self._recovery = {name: i for i, name in enumerate(mechanisms.recoveries)}
        self._detections_for = {
            recovery: frozenset(mechanisms.detect[ftm] for ftm in mechanisms.names
                                if mechanisms.recover[ftm] == recovery)
            for recovery in mechanisms.recoveries}

    def initial(self, now: float, number: int = 0) -> State:
        """Return the state in which an arbiter starts.

        Args:
            now: Time, seconds.
            number: Decisions are numbered from here on. Give each incarnation of the manager a
                higher range, so that no two decisions of a run have the same number.
        """
        return State(
            tuple(DetectionTrack(name, heard_s=now) for name in self.mechanisms.detections),
            tuple(RecoveryTrack(Command(name, False, number))
                  for name in self.mechanisms.recoveries),
            number, NOTHING_ACTIVE, now)

    def step(self, state: State, event: Input, now: float) -> tuple[State, tuple[Output, ...]]:
        """Take one input.

        Args:
            state: As returned by `initial` or by the last step.
            event: What happened; a detection or recovery module that is not of this system is
                none of the arbiter's business and ignored.
            now: Time, seconds; never less than before.

        Returns:
            The new state, and what came of it: first commands, releases before activations, then
            the decision and answers.
        """
        answers: tuple[Output, ...] = ()
        match event:
            case DetectionHeard() if event.detection in self._detection:
                state = self._with_detection(state, detection_track.hear(
                    state.detections[self._detection[event.detection]], self.rules, now,
                    active=event.active, reason=event.reason, nodes=event.nodes,
                    since_s=event.since_s))
            case DetectionRestarted() if event.detection in self._detection:
                state = self._with_detection(state, detection_track.excuse(
                    state.detections[self._detection[event.detection]], now))
            case RecoveryHeard() if event.recovery in self._recovery:
                state = self._hear_recovery(state, event, now)
            case ResetAsked():
                state, answer = self._reset(state, event)
                answers = (answer,)
        state = self._pass_time(state, now)
        state, outputs = self._settle(state, now)
        return state, outputs + answers

    def _with_detection(self, state: State, track: DetectionTrack) -> State:
        index = self._detection[track.name]
        return msgspec.structs.replace(state, detections=(
            *state.detections[:index], track, *state.detections[index + 1:]))

    def _with_recovery(self, state: State, track: RecoveryTrack) -> State:
        index = self._recovery[track.name]
        return msgspec.structs.replace(state, recoveries=(
            *state.recoveries[:index], track, *state.recoveries[index + 1:]))

    def _hear_recovery(self, state: State, event: RecoveryHeard, now: float) -> State:
        track = state.recoveries[self._recovery[event.recovery]]
        if event.activated and not state.oriented and not track.wanted and not track.heard:
            track = msgspec.structs.replace(
                track, ordered_s=now, adopted=True,
                latched=self.mechanisms.contracts[event.recovery].latched,
                command=Command(event.recovery, True, event.decision,
                                reason="adopted, it was found activated"))
        track = recovery_track.report(
            track, now, activated=event.activated, phase=event.phase, decision=event.decision,
            reason=event.reason)
        if track.failure and not track.failed_for:
            track = msgspec.structs.replace(track, failed_for=state.decision.active)
        state = msgspec.structs.replace(state, number=max(state.number, event.decision))
        return self._with_recovery(state, track)

    def _reset(self, state: State, event: ResetAsked) -> tuple[State, ResetAnswered]:
        name = event.recovery
        index = self._recovery.get(name, -1)
        if index < 0 or not state.recoveries[index].latched:
            problem = "it is not latched" if index >= 0 else "there is no such recovery module"
            return state, ResetAnswered(name, False, problem)
        chosen, _ = self._choose(state)
        if name in chosen.recoveries:
            return state, ResetAnswered(
                name, False, f"the cause persists: {', '.join(chosen.active)} active")
        track = msgspec.structs.replace(state.recoveries[index], latched=False, adopted=False)
        return self._with_recovery(state, track), ResetAnswered(
            name, True, f"reset by {event.by}" if event.by else "reset")

    def _pass_time(self, state: State, now: float) -> State:
        detections = tuple(detection_track.pass_time(track, self.rules, now)
                           for track in state.detections)
        believed = {track.name: track for track in detections}
        active = self.mechanisms.detected_by(t.name for t in detections if t.active)
        recoveries = tuple(self._judge(track, believed, active, now) for track in state.recoveries)
        oriented = state.oriented or now - state.started_s >= self.rules.startup_grace_s or (
            all(t.ever_heard for t in detections) and all(t.heard for t in recoveries))
        if oriented and not state.oriented:
            recoveries = tuple(msgspec.structs.replace(t, adopted=False) for t in recoveries)
        return msgspec.structs.replace(
            state, detections=detections, recoveries=recoveries, oriented=oriented)

    def _judge(self, track: RecoveryTrack, believed: dict[str, DetectionTrack],
               active: tuple[str, ...], now: float) -> RecoveryTrack:
        """Find a recovery to have failed, or forgive it."""
        if track.failure:
            if not set(track.failed_for) & set(active):
                return msgspec.structs.replace(track, failure="", failed_for=())
            return track
        contract = self.mechanisms.contracts[track.name]
        if not track.wanted or now - track.ordered_s <= contract.deadline_s:
            return track
        failure = ""
        if track.unfinished:
            failure = f"not done within {contract.deadline_s:g} s"
        elif contract.kind.repairs and not track.draining:
            # What it was not told of yet, it cannot have repaired.
            lasting = sorted(
                name for name, rises in track.cause
                if believed[name].asserted and believed[name].rises == rises
                and set(believed[name].nodes) <= set(track.command.nodes))
            if lasting:
                failure = (f"done, but {', '.join(lasting)} still active after "
                           f"{contract.deadline_s:g} s")
        if not failure:
            return track
        return msgspec.structs.replace(track, failure=failure, failed_for=active)

    def _choose(self, state: State) -> tuple[Decision, Decision]:
        """Return the decision after escalation, and that after latching on top of it."""
        active = self.mechanisms.detected_by(t.name for t in state.detections if t.active)
        decision = self.strategy(active, self.mechanisms, self.tree, self.order)
        failures = {t.name: t.failure for t in state.recoveries if t.failure}
        if failures:
            decision = escalate(decision, failures, self.mechanisms, self.tree)
        kept = [t for t in state.recoveries if t.latched or t.adopted]
        if not kept:
            return decision, decision
        # Several are kept only if one drains under another; the safest is the one in force.
        safest = min(kept, key=lambda t: self.order.number[t.name])
        winners = tuple(name for name in decision.recoveries
                        if name == safest.name or self.order.is_above(name, safest.name))
        losers = tuple(name for name in decision.recoveries if name not in winners)
        why = "is latched until reset" if safest.latched else "was found activated, and not all " \
            "modules have been heard yet"
        return decision, msgspec.structs.replace(
            decision, recoveries=winners or (safest.name,),
            rejected=decision.rejected + tuple((name, f"{safest.name} {why}") for name in losers))

    def _settle(self, state: State, now: float) -> tuple[State, tuple[Output, ...]]:
        """Decide, then command: release what is not chosen, activate what is."""
        _, decision = self._choose(state)
        chosen = decision.recoveries
        causes = {name: self._cause(state, name) for name in chosen}
        changed = decision != state.decision
        again = any(self._is_new(self._track(state, name), *causes[name]) for name in chosen)
        outputs: list[Output] = []
        if changed or again:
            state = msgspec.structs.replace(state, number=state.number + 1, decision=decision)
        for track in state.recoveries:
            if track.wanted and track.name not in chosen:
                after = self._release(track, chosen, state.number)
                state = self._with_recovery(state, after)
                if not after.wanted:
                    outputs.append(after.command)
        for name in chosen:
            before = self._track(state, name)
            after = self._activate(state, before, *causes[name], now)
            state = self._with_recovery(state, after)
            lost = after.activated is False and before.wanted and self._lost(before, after)
            if after.command != before.command or lost:
                outputs.append(after.command)
        if changed or again:
            outputs.append(DecisionMade(state.number, decision, self._detected_s(state, now)))
        return state, tuple(outputs)
