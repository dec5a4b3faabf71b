"""The arbiter: from what detection and recovery modules report to what recovery modules do.

A pure state machine, `step(state, input, now) -> (state, outputs)`: it reads no clock, sends
nothing, and its state is immutable, so a timeline can be tested as one and all its reachable
states can be explored. The strategy decides *which* recovery; the arbiter sees to *how*:

* Exactly one recovery runs under a strategy that is exclusive, as the paper's is; before one is
  activated, every other is released. Under others those run together that the strategy chose.
* No two hold the same resource. One that claims what a released one claimed waits for that one's
  word that it has let go, or for its deadline, whichever comes first: a release is a message, and
  a message takes time. Nothing claims what the last resort claims, so that never waits.
* None is cut off. One that is not interruptible and is acting, or may be because the order is
  still on its way, is not released but *drains*: it stays under orders until it reports that it
  is done, degraded or idle. What comes next waits for it, with one exception: a safer recovery
  that shares no claim with it starts at once. So an emergency stop never waits for a respawn.
* A recovery whose cause has cleared is released, and hands control back. A latched one stays
  until it is reset; only a safer one takes its place meanwhile. A reset is refused while the
  cause persists. What a detection explains for a while, as an overload of the machine does many,
  neither counts meanwhile nor latches (`Mechanism.explains`, `Contract.excused_by`); what outlasts
  it does both.
* A recovery that fails, is not done by its deadline, or needs a node that is reported failed is
  followed by the one it escalates to, else by that of the mechanism above. A repair also fails if
  it is done but its cause persists. One that is late but still acting is let be as long as no
  other one has to wait for it: late is better than never.
* An arbiter that starts while recoveries are activated, because the one before it was killed,
  adopts them, and releases none before it has heard every module (or has waited long enough).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from msgspec.structs import replace

from rampart.manager.arbitration import detection_track
from rampart.manager.arbitration.arbiter_state import (
    Command,
    DecisionMade,
    Input,
    Output,
    RecoveryHeard,
    RecoveryTrack,
    ResetAnswered,
    ResetAsked,
    ShadowDiffered,
    State,
)
from rampart.manager.arbitration.detection_track import (
    DetectionHeard,
    DetectionRules,
    DetectionTrack,
    said,
)
from rampart.manager.model.mechanisms import RecoveryPhase
from rampart.manager.spec.budget import patience_s
from rampart.manager.spec.schema import SystemSpec
from rampart.manager.strategies.arrangement import Arrangement
from rampart.manager.strategies.decision import NOTHING_ACTIVE, Decision, Strategy
from rampart.manager.strategies.escalation import escalate
from rampart.manager.strategies.registry import Decider, find_strategy

LARGEST_NUMBER = 1 << 52
"""A decision number beyond it was never given, although it be reported or remembered. What may
follow still fits into a message (`rampart.actors.bus.bounds.Count`)."""

EXCUSE_S = 5.0
"""So long before what excuses it was detected may a latch have come: an overload begins before it
is noticed."""



class Arbiter:
    """The rules; all that changes is in `State`.

    Args:
        arrangement: Mechanisms with their contracts, FTMTree, RM order.
        strategy: The policy.
        rules: For belief in detection modules.
        shadow: A policy that is asked as well, and whose differing decisions are told.
    """

    def __init__(self, arrangement: Arrangement, strategy: Strategy, rules: DetectionRules,
                 shadow: Strategy | None = None) -> None:
        self.arrangement = arrangement
        self.mechanisms = mechanisms = arrangement.mechanisms
        self.order = arrangement.order
        self.decider = Decider(strategy, arrangement)
        self.shadow = Decider(shadow, arrangement) if shadow else None
        self.rules = rules
        self._patient = strategy.patient or (shadow is not None and shadow.patient)
        self._no_hold = replace(rules, release_hold_s=0.0, release_hold_max_s=0.0)
        self._detection = {name: i for i, name in enumerate(mechanisms.detections)}
        self._recovery = {name: i for i, name in enumerate(mechanisms.recoveries)}
        self._needy = {name for name, c in mechanisms.contracts.items() if c.needs}

    def explain(self, made: DecisionMade) -> Decision:
        """Return a decision with its certificate, what the arbiter itself rejected included."""
        reasons = self.decider.explain(made.chosen)
        return replace(
            made.decision, path=reasons.path, rejected=reasons.rejected + made.decision.rejected)

    def _rules_of(self, state: State, detection: str) -> DetectionRules:
        # The hold keeps a forward recovery (a stop) from being taken up and let go with every
        # flap. A repair that has been done has ended by itself. Held, its mechanism would still
        # count when another becomes active, and two unrelated crashes a second apart would end
        # in an emergency stop (block 4).
        repairs = self.mechanisms.repairs.get(detection, ())
        if repairs and all(
                track.phase is RecoveryPhase.DONE and track.acknowledged
                for track in (self._track(state, name) for name in repairs)):
            return self._no_hold
        return self.rules

    def initial(self, now: float, number: int = 0) -> State:
        """Return the state in which an arbiter starts.

        Args:
            now: Time, seconds.
            number: Decisions are numbered from here on. Give each incarnation of the manager a
                higher range, so that no two decisions of a run have the same number.
        """
        detections = (DetectionTrack(name, heard_s=now) for name in self.mechanisms.detections)
        recoveries = (RecoveryTrack(Command(name, False, number))
                      for name in self.mechanisms.recoveries)
        return State(tuple(detections), tuple(recoveries), number, NOTHING_ACTIVE, now)

    def step(self, state: State, event: Input, now: float) -> tuple[State, tuple[Output, ...]]:
        """Take one input.

        Args:
            state: As returned by `initial` or by the last step.
            event: What happened; a detection or recovery module that is not of this system is
                ignored.
            now: Time, seconds; never less than before.

        Returns:
            The new state, and what came of it: first commands, releases before activations, then
            the decision and answers.
        """
        answers: tuple[Output, ...] = ()
        match event:
            case DetectionHeard() if event.detection in self._detection:
                tracks = list(state.detections)
                index = self._detection[event.detection]
                tracks[index] = detection_track.hear(tracks[index], event, self.rules, now)
                state = replace(state, detections=tuple(tracks))
            case RecoveryHeard() if event.recovery in self._recovery:
                state = self._hear_recovery(state, event, now)
            case ResetAsked():
                state, answers = self._reset(state, event)
        if self._is_quiet(state, now):
            return state, answers
        late_before = state.late
        state = self._pass_time(state, now)
        state, outputs = self._settle(state, now, late_before)
        if isinstance(event, RecoveryHeard) and not event.activated \
                and event.recovery in self._recovery:
            track = self._track(state, event.recovery)
            if (track.wanted or track.letting_go) and track.command not in outputs:
                # It was respawned, or has not got the order yet.
                outputs = (track.command, *outputs)
        return state, outputs + answers

    def _is_quiet(self, state: State, now: float) -> bool:
        """Tell whether nothing is active, under orders or awaited, so that time changes nothing.

        Nearly always it is so, and a module of some kind is heard seventy times a second.
        """
        if not state.oriented or state.decision is not NOTHING_ACTIVE or state.since or state.late:
            return False
        oldest_s = now - self.rules.silence_timeout_s
        return not (any(t.active or t.heard_s < oldest_s for t in state.detections)
                    or any(t.command.activate or t.letting_go or t.latched or t.adopted or t.failure
                           for t in state.recoveries))

    def _track(self, state: State, recovery: str) -> RecoveryTrack:
        return state.recoveries[self._recovery[recovery]]

    def _with_recovery(self, state: State, track: RecoveryTrack) -> State:
        tracks = list(state.recoveries)
        tracks[self._recovery[track.name]] = track
        return replace(state, recoveries=tuple(tracks))

    def _hear_recovery(self, state: State, event: RecoveryHeard, now: float) -> State:
        track = self._track(state, event.recovery)
        number = state.number
        if event.activated and not state.oriented and not track.wanted and not track.heard:
            if event.decision <= LARGEST_NUMBER:  # a larger one was never given
                number = max(number, event.decision)
            command = Command(event.recovery, True, event.decision,
                              reason="adopted, it was found activated")
            track = replace(track, ordered_s=now, adopted=True, command=command,
                            latched=self.mechanisms.contracts[event.recovery].latched)
        track = track.heard_from(event, now)
        if track.failure and not track.failed_for:
            track = replace(track, failed_for=self._sakes(track.name, state.decision.active))
        return self._with_recovery(replace(state, number=number), track)

    def _reset(self, state: State, event: ResetAsked) -> tuple[State, tuple[ResetAnswered]]:
        unlatched = self._choose(state)[1]
        refusal = ""
        if event.recovery not in self._recovery:
            refusal = "there is no such recovery module"
        elif not self._track(state, event.recovery).latched:
            refusal = "it is not latched"
        elif not state.oriented:
            refusal = "not all modules have been heard yet"
        elif event.recovery in unlatched.recoveries:
            refusal = f"the cause persists: {', '.join(unlatched.active)} active"
        else:
            state = self._with_recovery(state, replace(
                self._track(state, event.recovery), latched=False, adopted=False))
        return state, (ResetAnswered(event.recovery, not refusal, refusal or (
            f"reset by {event.by}" if event.by else "reset")),)

    def _pass_time(self, state: State, now: float) -> State:
        detections = tuple(detection_track.pass_time(t, self._rules_of(state, t.name), now)
                           for t in state.detections)
        believed = {track.name: track for track in detections}
        active, reported = self._active(detections), said(detections)
        recoveries = tuple(
            self._excuse(self._judge(t, believed, active, now), believed, reported)
            for t in state.recoveries)
        oriented = state.oriented or (
            all(t.ever_heard or t.silent for t in detections) and (
                all(t.heard for t in recoveries)
                or now - state.started_s > self.rules.startup_grace_s))
        if oriented and not state.oriented:
            recoveries = tuple(replace(t, adopted=False) for t in recoveries)
        state = replace(state, detections=detections, recoveries=recoveries, oriented=oriented)
        return self._with_late(state, active, now) if self._patient else state

    def _sakes(self, recovery: str, active: tuple[str, ...]) -> tuple[str, ...]:
        """Return the active mechanisms for whose sake a recovery acts.

        One that was chosen for another's sake, by block 4 or by escalation, acts for all.
        """
        users = self.mechanisms.users[recovery]
        return tuple(name for name in active if name in users) or active

    def _judge(self, track: RecoveryTrack, believed: Mapping[str, DetectionTrack],
               active: tuple[str, ...], now: float) -> RecoveryTrack:
        """Find a recovery to have failed, or forgive it."""
        if track.failure:
            forgiven = set(track.failed_for).isdisjoint(active)
            return replace(track, failure="", failed_for=()) if forgiven else track
        contract = self.mechanisms.contracts[track.name]
        if now - track.ordered_s <= contract.deadline_s:
            return track
        if track.letting_go:  # one that does not answer for so long is dead, and holds nothing
            return replace(track, letting_go=False)
        if not track.wanted or not (active or track.draining):
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
        return replace(track, failure=failure, failed_for=self._sakes(track.name, active))

    def _excuse(self, track: RecoveryTrack, believed: Mapping[str, DetectionTrack],
                reported: frozenset[str]) -> RecoveryTrack:
        """Undo a latch that is excused, unless it came long before what excuses it."""
        excusing = self.mechanisms.contracts[track.name].excused_by & reported
        if track.latched and any(
                track.latched_s >= believed[name].since_s - EXCUSE_S for name in excusing):
            return replace(track, latched=False)
        return track

    def _with_late(self, state: State, active: tuple[str, ...], now: float) -> State:
        """Note since when mechanisms have had their turn, and which of them are late.

        One that has to wait for a deeper one does not lose its patience meanwhile, or it would be
        late, and the next above in force, the moment the deeper one has succeeded. One whose
        recovery is in force is not late; but a repair ends the error or it does not.
        """
        tree, mechanisms = self.arrangement.tree, self.mechanisms
        before = dict(state.since)
        in_time = [name for name in active if name not in state.late]
        since = tuple((name, now if any(tree.is_above(name, deeper) for deeper in in_time)
                       else before.get(name, now)) for name in active)
        in_force = {track.name for track in state.recoveries
                    if track.in_force and not mechanisms.contracts[track.name].kind.repairs}
        return replace(state, since=since, late=frozenset(
            name for name, since_s in since
            if name in state.late or (now - since_s > mechanisms.by_name[name].patience_s
                                      and not in_force.issuperset(mechanisms.recover[name]))))

    def _active(self, detections: tuple[DetectionTrack, ...]) -> tuple[str, ...]:
        active = self.mechanisms.detected_by(
            (t.name for t in detections if t.active), (t.name for t in detections if t.silent))
        return self.mechanisms.unexplained(active, said(detections))

    def _choose(self, state: State) -> tuple[Decision, Decision, Decision]:
        """Return the strategy's decision, that after escalation, and that after latching too."""
        chosen = decision = self.decider.choose(self._active(state.detections), state.late)
        failures = self._unmet(state) if self._needy and chosen.active else {}
        failures |= {t.name: t.failure for t in state.recoveries if t.failure}
        if failures:
            decision = escalate(decision, failures, self.arrangement)
        return chosen, decision, self._keep_latched(state, decision)

    def _keep_latched(self, state: State, decision: Decision) -> Decision:
        """Return a decision in which the safest of the kept recoveries stays, or a safer one runs.

        A latched recovery stays until an operator resets it. An adopted one was found activated by
        an arbiter that had just started, and stays until all modules have been heard. Several stay
        only if one drains under another.
        """
        kept = [t for t in state.recoveries if t.latched or t.adopted]
        if not kept:
            return decision
        safest = min(kept, key=lambda track: self.order.number[track.name])
        base = tuple(name for name in decision.recoveries if name == safest.name
                     or self.order.is_above(name, safest.name)) or (safest.name,)
        others = [name for name in decision.recoveries if name not in base]
        beneath = () if self.decider.strategy.exclusive else tuple(
            name for name in others if self.mechanisms.contracts[name].kind.repairs
            and self.arrangement.can_join(name, base))
        why = "is latched until reset" if safest.latched else \
            "was found activated, and not all modules have been heard yet"
        return replace(decision, recoveries=base + beneath, rejected=decision.rejected + tuple(
            (name, f"{safest.name} {why}") for name in others if name not in beneath))

    def _unmet(self, state: State) -> dict[str, str]:
        """Return why recoveries are of no use now: a node that they need is reported failed."""
        failed = {node: t.name for t in state.detections if t.active for node in t.nodes}
        return {name: f"needs {node}, which {failed[node]} reports failed"
                for name in sorted(self._needy)
                for node in sorted(self.mechanisms.contracts[name].needs & failed.keys())[:1]}

    def _settle(self, state: State, now: float, late_before: frozenset[str]
                ) -> tuple[State, tuple[Output, ...]]:
        """Decide, then command: release what is not chosen, activate what is."""
        strategys, _, decision = self._choose(state)
        chosen = decision.recoveries
        fresh = decision != state.decision or any(
            self._has_new_cause(state, self._track(state, name)) for name in chosen)
        if fresh:
            state = replace(state, number=state.number + 1, decision=decision)
        outputs: list[Output] = []
        for before in state.recoveries:
            if before.wanted and before.name not in chosen:
                after = self._release(before, chosen, state.number, now)
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
            outputs.append(DecisionMade(state.number, decision, detected_s, strategys))
        if fresh or state.late != late_before:  # a patient shadow may have climbed alone
            outputs.extend(self._ask_shadow(state, strategys))
        return state, tuple(outputs)

    def _ask_shadow(self, state: State, chosen: Decision) -> tuple[ShadowDiffered, ...]:
        if self.shadow is not None:
            other = self.shadow.choose(chosen.active, state.late)
            if set(other.recoveries) != set(chosen.recoveries):
                return (ShadowDiffered(
                    state.number, self.shadow.strategy.name, other, chosen.recoveries),)
        return ()

    def _causes(self, state: State, recovery: str) -> list[DetectionTrack]:
        """Return the active detection modules that a recovery answers to.

        One that was chosen for another's sake, by block 4 or by escalation, answers to all.
        """
        active = [track for track in state.detections if track.active]
        own = [track for track in active if track.name in self.mechanisms.causes[recovery]]
        return own or active

    def _has_new_cause(self, state: State, track: RecoveryTrack) -> bool:
        """Tell whether a recovery under orders has to be ordered again.

        Only a repair has to: it is an action, and there is more to repair. A forward recovery is
        a state, which is in force already.
        """
        return (track.wanted and self.mechanisms.contracts[track.name].kind.repairs
                and self._is_news(state, track))

    def _is_news(self, state: State, track: RecoveryTrack, named: Callable[[str], str] = str
                 ) -> bool:
        """Tell whether its causes, with nodes named like this, are more than it was told of."""
        told = {named(node) for node in track.command.nodes}
        return any((cause.name, cause.rises) not in track.cause
                   or not {named(node) for node in cause.nodes} <= told
                   for cause in self._causes(state, track.name))

    def _release(self, track: RecoveryTrack, chosen: tuple[str, ...], number: int, now: float
                 ) -> RecoveryTrack:
        """Release a recovery, or let it drain."""
        if track.unfinished and not self.mechanisms.contracts[track.name].interruptible:
            in_the_way = any(self.mechanisms.overlap(track.name, name) for name in chosen)
            if not track.failure or (track.acknowledged and not in_the_way):
                return replace(track, draining=True)
        reason = f"superseded by {', '.join(chosen)}" if chosen else "the cause is gone"
        return replace(
            track, command=Command(track.name, False, number, reason=reason), cause=frozenset(),
            ordered_s=now, acknowledged=False, draining=False, adopted=False,
            letting_go=not track.failure)  # the word of one that failed is not waited for

    def _activate(self, state: State, track: RecoveryTrack, now: float) -> RecoveryTrack:
        """Activate a recovery, order it again if need be, or let it wait for another to drain."""
        ordered_s = now
        activated = track
        if not track.latched and self._latches(state, track):
            activated = replace(track, latched=True, latched_s=now)
        if track.wanted:
            if not self._has_new_cause(state, track):
                return replace(activated, draining=False)
            if not track.acknowledged or not self._is_news(state, track, _without_incarnation):
                # It has been deaf since then; or its detection has not cleared and blames one
                # incarnation of a node after the other: it has not ended the error.
                ordered_s = track.ordered_s
        elif any(self._blocks(other, track.name, state.decision.recoveries)
                 for other in state.recoveries):
            return track
        causes = self._causes(state, track.name)
        nodes = tuple(dict.fromkeys(node for cause in causes for node in cause.nodes))
        reason = "; ".join(f"{cause.name}: {cause.reason}" if cause.reason else cause.name
                           for cause in causes)
        return replace(
            activated, command=Command(track.name, True, state.number, nodes, reason),
            ordered_s=ordered_s, cause=frozenset((cause.name, cause.rises) for cause in causes),
            acknowledged=False, draining=False, letting_go=False, adopted=False)

    def _latches(self, state: State, track: RecoveryTrack) -> bool:
        """Tell whether a recovery that is chosen stays until it is reset.

        One that was excused when it was taken up does if its cause outlasts the excuse.
        """
        contract = self.mechanisms.contracts[track.name]
        return contract.latched and contract.excused_by.isdisjoint(said(state.detections)) and (
            not track.wanted or any(c.asserted for c in self._causes(state, track.name)))

    def _blocks(self, other: RecoveryTrack, name: str, chosen: tuple[str, ...]) -> bool:
        """Tell whether a recovery has to wait for another to drain, or to let go."""
        if other.name == name:
            return False
        busy = other.unfinished and not other.failure
        if self.mechanisms.overlap(name, other.name):
            return busy or other.letting_go
        if other.name in chosen or not busy or not self.decider.strategy.exclusive:
            return False
        return not self.order.is_above(name, other.name)


def _without_incarnation(node: str) -> str:
    """Return the name of a node that is blamed as NODE#INCARNATION, or as it is."""
    return node.partition("#")[0]


def build_arbiter(spec: SystemSpec, *, first_start: bool = True) -> Arbiter:
    """Build the arbiter of a system.

    Args:
        spec: The system.
        first_start: Whether modules may be starting as well, and are waited for accordingly; those
            of an arbiter that was respawned run already.

    Raises:
        UnknownStrategyError: No such strategy.
    """
    timing = spec.timing
    silence_s = timing.detection_silence_timeout_s
    arrangement = Arrangement(
        spec.build_mechanisms(patience_s(spec)), spec.build_ftm_tree(), spec.build_order())
    rules = DetectionRules(silence_s, timing.startup_grace_s if first_start else silence_s,
                           timing.release_hold_s, timing.release_hold_max_s)
    return Arbiter(arrangement, find_strategy(spec.strategy), rules,
                   find_strategy(spec.shadow) if spec.shadow else None)
