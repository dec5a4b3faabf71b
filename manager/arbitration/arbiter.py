"""The arbiter: from reports of detection and recovery modules to commands.

It is a pure state machine, `step(state, input, now) -> (state, outputs)`, with an immutable state.
So tests are timelines, and all reachable states can be explored. The strategy decides *which*
recoveries run; the arbiter decides *how*:

* Under an exclusive strategy, such as the paper's, one recovery runs: every other is released
  first. Under others, the recoveries that the strategy chose run together.
* No two recoveries hold the same resource. The successor of a released recovery with a common claim
  waits until that one reports that it has let go, or until its deadline. No other recovery claims
  what the last resort claims, so the last resort never waits.
* None is cut off. A recovery that is not interruptible, and acts or may have begun to, *drains*: it
  stays under orders until it reports done, degraded or idle. Its successor waits, except for a
  safer recovery without a common claim. So an emergency stop never waits for a respawn.
* A recovery whose cause has cleared is released. A latched one stays until it is reset; only a
  safer one takes its place meanwhile. A reset is refused while the cause persists. A cause that
  another detection explains, such as an overload of the machine, neither counts nor latches
  (`Mechanism.explains`, `Contract.excused_by`) unless it outlasts the explanation.
* A mechanism that clears by operator, never, or after a time stays active when its error is gone,
  so the strategy decides as if it were detected. A reset of its recovery ends it, not earlier than
  the reset of a latched recovery. Who may reset is checked where the operator is known.
* A recovery fails by its own report, by its deadline, or if it needs a node that is reported
  failed. It escalates to the one that its contract names, else to that of the mechanism above. A
  repair also fails if it is done but its cause persists. A failed recovery that is still acting may
  finish as long as no other waits for it.
* An arbiter that starts while recoveries are activated, because its predecessor was killed, adopts
  them. It releases none before every module has reported or the grace time has passed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from msgspec.structs import replace

from rampart.manager.arbitration import detection_track
from rampart.manager.arbitration.arbiter_state import (
    LONG_AGO_S,
    Command,
    DecisionMade,
    Held,
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
    reporting,
)
from rampart.manager.model.mechanisms import Clears, RecoveryPhase
from rampart.manager.spec.budget import patience_s
from rampart.manager.spec.schema import SystemSpec
from rampart.manager.strategies.arrangement import Arrangement
from rampart.manager.strategies.decision import NOTHING_ACTIVE, Decision, Strategy
from rampart.manager.strategies.escalation import escalate
from rampart.manager.strategies.registry import Decider, find_strategy

LARGEST_NUMBER = 1 << 52
"""A reported or remembered decision number above it is false; its successors still fit into a
message (`rampart.actors.bus.bounds.Count`)."""

EXCUSE_S = 5.0
"""A latch up to this long before its excuse was detected is excused too: an overload begins before
it is detected."""


class Arbiter:
    """The rules; everything that changes is in `State`.

    Args:
        arrangement: Mechanisms with their contracts, FTMTree, RM order.
        strategy: The strategy that decides.
        rules: Times for belief in detection modules.
        shadow: A strategy without effect, whose differing decisions are reported.
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
        """Return a decision with its certificate and the arbiter's own rejections."""
        reasons = self.decider.explain(made.chosen)
        return replace(
            made.decision, path=reasons.path, rejected=reasons.rejected + made.decision.rejected)

    def _rules_of(self, state: State, detection: str) -> DetectionRules:
        # The hold prevents a stop from starting and ending with every flap. A finished repair
        # has ended by itself. If its mechanism were held active, two unrelated crashes a second
        # apart would end in an emergency stop (block 4).
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
            number: Number before that of the first decision. Each incarnation of the manager needs
                a higher range, so that no two decisions of a run have the same number.
        """
        detections = (DetectionTrack(name, heard_s=now) for name in self.mechanisms.detections)
        recoveries = (RecoveryTrack(Command(name, False, number))
                      for name in self.mechanisms.recoveries)
        return State(tuple(detections), tuple(recoveries), number, NOTHING_ACTIVE, now)

    def step(self, state: State, event: Input, now: float) -> tuple[State, tuple[Output, ...]]:
        """Take one input.

        Args:
            state: State from `initial` or from the last step.
            event: The input; reports of unknown modules are ignored.
            now: Time, seconds; never less than before.

        Returns:
            The new state, and the outputs: commands, releases before activations, then the
            decision and answers.
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
                state, answers = self._reset(state, event, now)
        if self._is_quiet(state, now):
            return state, answers
        late_before = state.late
        state = self._pass_time(state, now)
        state, outputs = self._settle(state, now, late_before)
        if isinstance(event, RecoveryHeard) and not event.activated \
                and event.recovery in self._recovery:
            track = self._track(state, event.recovery)
            if (track.wanted or track.letting_go) and track.command not in outputs:
                # It was respawned, or has not received the order yet.
                outputs = (track.command, *outputs)
        return state, outputs + answers

    def _is_quiet(self, state: State, now: float) -> bool:
        """Return whether nothing is active, under orders or awaited, so that time changes nothing.

        This is nearly always so, while seventy reports arrive a second.
        """
        if not state.oriented or state.decision is not NOTHING_ACTIVE or state.since \
                or state.late or state.held:
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
            if event.decision <= LARGEST_NUMBER:
                number = max(number, event.decision)
            command = Command(event.recovery, True, event.decision,
                              reason="adopted, it was found activated")
            track = replace(track, ordered_s=now, adopted=True, command=command,
                            latched=self.mechanisms.contracts[event.recovery].latched)
        track = track.heard_from(event, now)
        if track.failure and not track.failed_for:
            track = replace(track, failed_for=self._sakes(track.name, state.decision.active))
        return self._with_recovery(replace(state, number=number), track)

    def _refusal(self, state: State, event: ResetAsked, now: float) -> str:
        """Return why a reset is refused, or ""."""
        held = [h for h in state.held if _resets(event, h)]
        decision = self._choose(replace(
            state, held=tuple(h for h in state.held if h not in held)))[1]
        never = [h.mechanism for h in held if h.clears is Clears.NEVER]
        causes = [h.mechanism for h in held if h.mechanism in decision.active] or (
            list(decision.active) if event.recovery in decision.recoveries else [])
        early = [(h.mechanism, after_s) for h in held
                 for after_s in [self.mechanisms.by_name[h.mechanism].clear_after_s]
                 if now - h.seen_s < after_s]
        refusal = ""
        if event.recovery not in self._recovery:
            refusal = "the recovery module is unknown"
        elif event.recovery not in state.latched:
            refusal = "it is not latched"
        elif not state.oriented:
            refusal = "not all modules have reported yet"
        elif event.stamp_s < max(self._track(state, event.recovery).latched_s,
                                 *(h.since_s for h in held), LONG_AGO_S):
            refusal = "the reset is older than the latch"
        elif never:
            refusal = f"{', '.join(never)} never clears; only a new run ends it"
        elif causes:
            refusal = f"the cause persists: {', '.join(causes)} active"
        elif early:
            refusal = f"{early[0][0]} clears when its error has been gone for {early[0][1]:g} s"
        return refusal

    def _reset(self, state: State, event: ResetAsked, now: float
               ) -> tuple[State, tuple[ResetAnswered]]:
        refusal = self._refusal(state, event, now)
        if not refusal:
            state = self._with_recovery(
                replace(state, held=tuple(h for h in state.held if not _resets(event, h))),
                replace(self._track(state, event.recovery), latched=False, adopted=False))
        return state, (ResetAnswered(event.recovery, not refusal, refusal or (
            f"reset by {event.by}" if event.by else "reset")),)

    def _pass_time(self, state: State, now: float) -> State:
        detections = tuple(detection_track.pass_time(t, self._rules_of(state, t.name), now)
                           for t in state.detections)
        believed = {track.name: track for track in detections}
        reported = reporting(detections)
        held = self._hold(state.held, self._detected(detections), now)
        active = self._active(detections, held)
        recoveries = tuple(
            self._excuse(self._judge(t, believed, active, now), believed, reported)
            for t in state.recoveries)
        oriented = state.oriented or (
            all(t.ever_heard or t.silent for t in detections) and (
                all(t.heard for t in recoveries)
                or now - state.started_s > self.rules.startup_grace_s))
        if oriented and not state.oriented:
            recoveries = tuple(replace(t, adopted=False) for t in recoveries)
        state = replace(state, detections=detections, recoveries=recoveries, oriented=oriented,
                        held=held)
        return self._with_late(state, active, now) if self._patient else state

    def _sakes(self, recovery: str, active: tuple[str, ...]) -> tuple[str, ...]:
        """Return the active mechanisms that a recovery acts for: its own, else all.

        Block 4 or escalation may run a recovery of a mechanism that is not active.
        """
        users = self.mechanisms.users[recovery]
        return tuple(name for name in active if name in users) or active

    def _judge(self, track: RecoveryTrack, believed: Mapping[str, DetectionTrack],
               active: tuple[str, ...], now: float) -> RecoveryTrack:
        """Mark a recovery as failed, or clear its failure."""
        if track.failure:
            forgiven = set(track.failed_for).isdisjoint(active)
            return replace(track, failure="", failed_for=()) if forgiven else track
        contract = self.mechanisms.contracts[track.name]
        if now - track.ordered_s <= contract.deadline_s:
            return track
        if track.letting_go:  # without an answer until the deadline it is dead, and holds nothing
            return replace(track, letting_go=False)
        if not track.wanted or not (active or track.draining):
            return track  # latched or adopted, without a cause to escalate for
        failure = ""
        if track.unfinished:
            failure = f"not done within {contract.deadline_s:g} s"
        elif contract.kind.repairs and not track.draining:
            # Only what it was ordered to repair can have outlasted the repair.
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
        """Undo a latch that is excused, unless it is much older than the excuse."""
        excusing = self.mechanisms.contracts[track.name].excused_by & reported
        if track.latched and any(
                track.latched_s >= believed[name].since_s - EXCUSE_S for name in excusing):
            return replace(track, latched=False)
        return track

    def _with_late(self, state: State, active: tuple[str, ...], now: float) -> State:
        """Note since when mechanisms have had their turn, and which of them are late.

        A mechanism that waits for a deeper one keeps its patience; else it would be late as soon as
        the deeper one has succeeded. A mechanism whose forward recovery is in force is not late.
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

    def hold(self, mechanism: str, since_s: float, seen_s: float) -> Held:
        """Return a mechanism that stays active when its error is gone."""
        return Held(mechanism, self.mechanisms.recover[mechanism],
                    self.mechanisms.by_name[mechanism].clears, since_s, seen_s)

    def _hold(self, held: tuple[Held, ...], detected: tuple[str, ...], now: float
              ) -> tuple[Held, ...]:
        """Return what is held as of `now`: errors are noted, and what clears by itself is gone."""
        if not self.mechanisms.outlasting:
            return ()
        found = {h.mechanism: h for h in held}
        for name in self.mechanisms.outlasting.intersection(detected):
            found[name] = replace(found.get(name) or self.hold(name, now, now), seen_s=now)
        return tuple(
            found[name] for name in self.mechanisms.names if name in found and not (
                found[name].clears is Clears.BY_ITSELF and now - found[name].seen_s
                > self.mechanisms.by_name[name].clear_after_s))

    def _active(self, detections: tuple[DetectionTrack, ...], held: tuple[Held, ...]
                ) -> tuple[str, ...]:
        detected = self._detected(detections)
        return self.mechanisms.sort((*detected, *(h.mechanism for h in held))) if held else detected

    def _detected(self, detections: tuple[DetectionTrack, ...]) -> tuple[str, ...]:
        active = self.mechanisms.detected_by(
            (t.name for t in detections if t.active), (t.name for t in detections if t.silent))
        return self.mechanisms.unexplained(active, reporting(detections))

    def _choose(self, state: State) -> tuple[Decision, Decision, Decision]:
        """Return the strategy's decision, the one after escalation, and the one after latching."""
        active = self._active(state.detections, state.held)
        chosen = decision = self.decider.choose(active, state.late)
        failures = self._unmet(state) if self._needy and chosen.active else {}
        failures |= {t.name: t.failure for t in state.recoveries if t.failure}
        if failures:
            decision = escalate(decision, failures, self.arrangement)
        return chosen, decision, self._keep_latched(state, decision)

    def _keep_latched(self, state: State, decision: Decision) -> Decision:
        """Return a decision in which the safest of the kept recoveries stays, or a safer one runs.

        A latched recovery stays until an operator resets it, an adopted one until all modules have
        reported. Several stay only if one drains under another.
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
        """Return the recoveries that need a node which is reported failed, and why they fail."""
        failed = {node: t.name for t in state.detections if t.active for node in t.nodes}
        return {name: f"needs {node}, which {failed[node]} reports failed"
                for name in sorted(self._needy)
                for node in sorted(self.mechanisms.contracts[name].needs & failed.keys())[:1]}

    def _settle(self, state: State, now: float, late_before: frozenset[str]
                ) -> tuple[State, tuple[Output, ...]]:
        """Decide, then release what is not chosen, and activate what is."""
        by_strategy, _, decision = self._choose(state)
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
            outputs.append(DecisionMade(state.number, decision, detected_s, by_strategy))
        if fresh or state.late != late_before:  # a patient shadow may have climbed alone
            outputs.extend(self._ask_shadow(state, by_strategy))
        return state, tuple(outputs)

    def _ask_shadow(self, state: State, chosen: Decision) -> tuple[ShadowDiffered, ...]:
        if self.shadow is not None:
            other = self.shadow.choose(chosen.active, state.late)
            if set(other.recoveries) != set(chosen.recoveries):
                return (ShadowDiffered(
                    state.number, self.shadow.strategy.name, other, chosen.recoveries),)
        return ()

    def _causes(self, state: State, recovery: str) -> list[DetectionTrack]:
        """Return the active detection modules that a recovery answers to: its own, else all."""
        active = [track for track in state.detections if track.active]
        own = [track for track in active if track.name in self.mechanisms.causes[recovery]]
        return own or active

    def _has_new_cause(self, state: State, track: RecoveryTrack) -> bool:
        """Return whether a recovery under orders has to be ordered again.

        Only a repair has to, since it is an action. A forward recovery is a state that is in force
        already.
        """
        return (track.wanted and self.mechanisms.contracts[track.name].kind.repairs
                and self._is_news(state, track))

    def _is_news(self, state: State, track: RecoveryTrack, named: Callable[[str], str] = str
                 ) -> bool:
        """Return whether its causes or their nodes, as `named`, are more than in its command."""
        ordered = {named(node) for node in track.command.nodes}
        return any((cause.name, cause.rises) not in track.cause
                   or not {named(node) for node in cause.nodes} <= ordered
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
            letting_go=not track.failure)  # nothing waits for a failed one to let go

    def _activate(self, state: State, track: RecoveryTrack, now: float) -> RecoveryTrack:
        """Activate a recovery, order it again if necessary, or let it wait for another."""
        ordered_s = now
        activated = track
        if not track.latched and self._latches(state, track):
            activated = replace(track, latched=True, latched_s=now)
        if track.wanted:
            if not self._has_new_cause(state, track):
                return replace(activated, draining=False)
            if not track.acknowledged or not self._is_news(state, track, _without_incarnation):
                # The deadline goes on: it has not acknowledged, or its detection names further
                # incarnations of the same nodes, so that it has not ended the error.
                ordered_s = track.ordered_s
        elif any(self._blocks(other, track.name, state.decision.recoveries)
                 for other in state.recoveries):
            return track
        causes = self._causes(state, track.name)
        nodes = tuple(dict.fromkeys(node for cause in causes for node in cause.nodes))
        reason = "; ".join(f"{cause.name}: {cause.reason}" if cause.reason else cause.name
                           for cause in causes) or _kept(state.held)
        return replace(
            activated, command=Command(track.name, True, state.number, nodes, reason),
            ordered_s=ordered_s, cause=frozenset((cause.name, cause.rises) for cause in causes),
            acknowledged=False, draining=False, letting_go=False, adopted=False)

    def _latches(self, state: State, track: RecoveryTrack) -> bool:
        """Return whether a chosen recovery latches, also later if its cause outlasts the excuse."""
        contract = self.mechanisms.contracts[track.name]
        if not contract.latched or contract.excused_by & reporting(state.detections):
            return False
        return not track.wanted or any(c.asserted for c in self._causes(state, track.name))

    def _blocks(self, other: RecoveryTrack, name: str, chosen: tuple[str, ...]) -> bool:
        """Return whether a recovery has to wait for another to drain, or to let go."""
        if other.name == name:
            return False
        busy = other.unfinished and not other.failure
        if self.mechanisms.overlap(name, other.name):
            return busy or other.letting_go
        if other.name in chosen or not busy or not self.decider.strategy.exclusive:
            return False
        return not self.order.is_above(name, other.name)


def _resets(event: ResetAsked, held: Held) -> bool:
    """Return whether a granted reset ends what is held."""
    return held.clears is not Clears.BY_ITSELF and event.recovery in held.recoveries


def _kept(held: tuple[Held, ...]) -> str:
    """Return the reason of a recovery without a detection that is active."""
    return f"not cleared: {', '.join(h.mechanism for h in held)}" if held else ""


def _without_incarnation(node: str) -> str:
    return node.partition("#")[0]


def build_arbiter(spec: SystemSpec, *, first_start: bool = True) -> Arbiter:
    """Build the arbiter of a system.

    Modules get the grace time only at the `first_start`: those of a respawned arbiter run already.
    """
    timing = spec.timing
    silence_s = timing.detection_silence_timeout_s
    arrangement = Arrangement(
        spec.build_mechanisms(patience_s(spec)), spec.build_ftm_tree(), spec.build_order())
    rules = DetectionRules(silence_s, timing.startup_grace_s if first_start else silence_s,
                           timing.release_hold_s, timing.release_hold_max_s)
    return Arbiter(arrangement, find_strategy(spec.strategy), rules,
                   find_strategy(spec.shadow) if spec.shadow else None)
