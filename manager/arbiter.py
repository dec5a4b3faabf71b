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

import msgspec

from manager import detection_track, recovery_track
from manager.arbiter_state import (
    DecisionMade,
    DetectionHeard,
    DetectionRestarted,
    Input,
    Output,
    RecoveryHeard,
    ResetAnswered,
    ResetAsked,
    State,
    Tick,
)
from manager.decision import NOTHING_ACTIVE, Decision, Strategy
from manager.detection_track import DetectionRules, DetectionTrack
from manager.escalation import escalate
from manager.mechanisms import Mechanisms
from manager.order import PartialOrder, Tree
from manager.recovery_track import Command, Phase, RecoveryTrack
from manager.schema import SystemSpec
from manager.strategies import find_strategy

__all__ = [
    "Arbiter", "Command", "DecisionMade", "DetectionHeard", "DetectionRestarted", "Input",
    "Output", "Phase", "RecoveryHeard", "ResetAnswered", "ResetAsked", "State", "Tick",
    "build_arbiter",
]

MEMORY = 4096
"""Answers of the strategy to remember; seven mechanisms have 128 active sets."""


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
        self._no_hold = msgspec.structs.replace(rules, release_hold_s=0.0, release_hold_max_s=0.0)
        self._repairs = self._repaired_by(mechanisms)
        self._detection = {name: i for i, name in enumerate(mechanisms.detections)}
        self._recovery = {name: i for i, name in enumerate(mechanisms.recoveries)}
        self._decisions: dict[tuple[str, ...], Decision] = {}
        self._detections_for = {
            recovery: frozenset(mechanisms.detect[ftm] for ftm in mechanisms.names
                                if mechanisms.recover[ftm] == recovery)
            for recovery in mechanisms.recoveries}

    @staticmethod
    def _repaired_by(mechanisms: Mechanisms) -> dict[str, tuple[str, ...]]:
        """Return the recoveries of each detection module whose mechanisms only repair."""
        recoveries: dict[str, tuple[str, ...]] = {}
        for ftm in mechanisms.names:
            detection = mechanisms.detect[ftm]
            recoveries[detection] = (*recoveries.get(detection, ()), mechanisms.recover[ftm])
        return {detection: names for detection, names in recoveries.items()
                if all(mechanisms.contracts[name].kind.repairs for name in names)}

    def _rules_of(self, state: State, detection: str) -> DetectionRules:
        # The hold keeps a forward recovery (a stop) from being taken up and let go with every
        # flap. A repair that has been done has ended by itself. Held, its mechanism would still
        # count when another becomes active, and two unrelated crashes a second apart would end
        # in an emergency stop (block 4).
        repairs = self._repairs.get(detection, ())
        if repairs and all(
                track.phase is Phase.DONE and track.acknowledged
                for track in (state.recoveries[self._recovery[name]] for name in repairs)):
            return self._no_hold
        return self.rules

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
                    state.detections[self._detection[event.detection]],
                    self.rules, now,
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
        if isinstance(event, RecoveryHeard) and not event.activated:
            command = state.desired.get(event.recovery)
            if command is not None and command.activate and command not in outputs:
                outputs = (command, *outputs)  # it was respawned, or has not got the order yet
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
        detections = tuple(detection_track.pass_time(track, self._rules_of(state, track.name), now)
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
        if not active and not track.draining:
            return track  # latched or adopted: there is nothing to escalate for
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
        decision = self._decide(active)
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

    def _decide(self, active: tuple[str, ...]) -> Decision:
        """Ask the strategy, which is pure: the answer to a question asked before is known."""
        if active not in self._decisions:
            if len(self._decisions) >= MEMORY:
                self._decisions.clear()
            self._decisions[active] = self.strategy(
                active, self.mechanisms, self.tree, self.order)
        return self._decisions[active]

    def _settle(self, state: State, now: float) -> tuple[State, tuple[Output, ...]]:
        """Decide, then command: release what is not chosen, activate what is."""
        _, decision = self._choose(state)
        chosen = decision.recoveries
        fresh = decision != state.decision or any(
            self._has_new_cause(state, self._track(state, name)) for name in chosen)
        if fresh:
            state = msgspec.structs.replace(state, number=state.number + 1, decision=decision)
        outputs: list[Output] = []
        for before in state.recoveries:
            if before.wanted and before.name not in chosen:
                after = self._release(before, chosen, state.number)
                state = self._with_recovery(state, after)
                if after.command != before.command:
                    outputs.append(after.command)
        for name in chosen:
            before = self._track(state, name)
            after = self._activate(state, before, now)
            state = self._with_recovery(state, after)
            if after.command != before.command:
                outputs.append(after.command)
        if fresh:
            detected_s = max((t.since_s for t in state.detections if t.active), default=now)
            outputs.append(DecisionMade(state.number, decision, detected_s))
        return state, tuple(outputs)

    def _track(self, state: State, recovery: str) -> RecoveryTrack:
        return state.recoveries[self._recovery[recovery]]

    def _causes(self, state: State, recovery: str) -> list[DetectionTrack]:
        """Return the active detection modules that a recovery answers to.

        One that was chosen for another's sake, by block 4 or by escalation, answers to all.
        """
        active = [track for track in state.detections if track.active]
        own = [track for track in active if track.name in self._detections_for[recovery]]
        return own or active

    def _has_new_cause(self, state: State, track: RecoveryTrack) -> bool:
        """Tell whether a recovery under orders has to be ordered again.

        Only a repair has to: it is an action, and there is more to repair. A forward recovery is
        a state, which is in force already.
        """
        if not track.wanted or not self.mechanisms.contracts[track.name].kind.repairs:
            return False
        return any((cause.name, cause.rises) not in track.cause
                   or not set(cause.nodes) <= set(track.command.nodes)
                   for cause in self._causes(state, track.name))

    def _release(self, track: RecoveryTrack, chosen: tuple[str, ...], number: int
                 ) -> RecoveryTrack:
        """Release a recovery, or let it drain."""
        if track.unfinished and not self.mechanisms.contracts[track.name].interruptible:
            in_the_way = any(self.mechanisms.overlap(track.name, name) for name in chosen)
            if not track.failure or (track.acknowledged and not in_the_way):
                return msgspec.structs.replace(track, draining=True)
        reason = f"superseded by {', '.join(chosen)}" if chosen else "the cause is gone"
        return msgspec.structs.replace(
            track, command=Command(track.name, False, number, reason=reason), cause=frozenset(),
            acknowledged=False, draining=False, adopted=False)

    def _activate(self, state: State, track: RecoveryTrack, now: float) -> RecoveryTrack:
        """Activate a recovery, order it again if need be, or let it wait for another to drain."""
        ordered_s = now
        if track.wanted:
            if not self._has_new_cause(state, track):
                return msgspec.structs.replace(track, draining=False)
            if not track.acknowledged:
                ordered_s = track.ordered_s  # it has been deaf since then
        elif any(self._blocks(other, track.name, state.decision.recoveries)
                 for other in state.recoveries):
            return track
        causes = self._causes(state, track.name)
        nodes = tuple(dict.fromkeys(node for cause in causes for node in cause.nodes))
        reason = "; ".join(f"{cause.name}: {cause.reason}" if cause.reason else cause.name
                           for cause in causes)
        return msgspec.structs.replace(
            track, command=Command(track.name, True, state.number, nodes, reason),
            ordered_s=ordered_s, cause=frozenset((cause.name, cause.rises) for cause in causes),
            acknowledged=False, draining=False, adopted=False,
            latched=track.latched or self.mechanisms.contracts[track.name].latched)

    def _blocks(self, other: RecoveryTrack, name: str, chosen: tuple[str, ...]) -> bool:
        """Tell whether a recovery has to wait for another to drain."""
        if other.name in chosen or not other.unfinished or other.failure:
            return False
        return self.mechanisms.overlap(name, other.name) \
            or not self.order.is_above(name, other.name)


def build_arbiter(spec: SystemSpec, strategy: str = "") -> Arbiter:
    """Build the arbiter of a system.

    Args:
        spec: The system.
        strategy: Name of a strategy; "" for the one that the spec names.

    Raises:
        UnknownStrategyError: No such strategy.
    """
    timing = spec.timing
    return Arbiter(
        spec.build_mechanisms(), spec.build_ftm_tree(), spec.build_order(),
        find_strategy(strategy or spec.strategy),
        DetectionRules(timing.detection_silence_timeout_s, timing.startup_grace_s,
                       timing.release_hold_s, timing.release_hold_max_s))
