"""What goes into the arbiter, what comes out of it, and what it knows in between."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
from msgspec.structs import replace

from rampart.manager.arbitration.detection_track import DetectionHeard, DetectionTrack
from rampart.manager.arbitration.recovery_track import Command, RecoveryHeard, RecoveryTrack
from rampart.manager.strategies.arrangement import Arrangement
from rampart.manager.strategies.decision import Decision


class ResetAsked(msgspec.Struct, frozen=True, tag=True):
    """Input: an operator request to release a latched recovery."""

    recovery: str
    by: str = ""


class Tick(msgspec.Struct, frozen=True, tag=True):
    """Input: nothing but time has passed."""


Input = DetectionHeard | RecoveryHeard | ResetAsked | Tick


class DecisionMade(msgspec.Struct, frozen=True, tag=True):
    """Output: a decision, as it is carried out. `Arbiter.explain` adds the certificate.

    Attributes:
        number: Counts up; commands refer to it.
        decision: The strategy's, but `recoveries` are those that the arbiter takes after
            escalation and latching, and `rejected` says so.
        detected_s: When the youngest of its causes was detected.
        chosen: The strategy's, before escalation and latching.
    """

    number: int
    decision: Decision
    detected_s: float
    chosen: Decision


class ShadowDiffered(msgspec.Struct, frozen=True, tag=True):
    """Output: the strategy that runs in shadow would have run other recoveries.

    Attributes:
        number: Of the decision that was taken instead.
        strategy: Name of the shadow strategy.
        decision: What it would have decided.
        taken: Recoveries that the active strategy chose.
    """

    number: int
    strategy: str
    decision: Decision
    taken: tuple[str, ...]


class ResetAnswered(msgspec.Struct, frozen=True, tag=True):
    """Output: a reset was granted, or refused for a reason."""

    recovery: str
    granted: bool
    reason: str


Output = Command | DecisionMade | ShadowDiffered | ResetAnswered


class State(msgspec.Struct, frozen=True):
    """Everything the arbiter knows.

    Attributes:
        detections: One track for each detection module, in the sequence of the registry.
        recoveries: One track for each recovery module, likewise.
        number: Of the last decision.
        decision: The last decision, as carried out.
        started_s: When the arbiter started.
        oriented: It has heard every module, or has waited long enough; adoption is over.
        since: Active mechanisms, each with the time since when it is active.
        late: Those whose recovery has not ended the error within its patience.
    """

    detections: tuple[DetectionTrack, ...]
    recoveries: tuple[RecoveryTrack, ...]
    number: int
    decision: Decision
    started_s: float
    oriented: bool = False
    since: tuple[tuple[str, float], ...] = ()
    late: frozenset[str] = frozenset()

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
    def busy(self) -> tuple[str, ...]:
        """Names of the recovery modules that are in the middle of something."""
        return tuple(track.name for track in self.recoveries
                     if track.wanted or track.letting_go or track.latched)

    @property
    def latched(self) -> tuple[str, ...]:
        """Names of the recovery modules that stay until they are reset."""
        return tuple(track.name for track in self.recoveries if track.latched)


def with_late(state: State, active: tuple[str, ...], arrangement: Arrangement, now: float) -> State:
    """Note since when mechanisms have had their turn, and which of them are late.

    One that has to wait for a deeper one does not lose its patience meanwhile, or it would be
    late, and the next above in force, the moment the deeper one has succeeded. One whose recovery
    is in force is not late; but a repair ends the error or it does not.
    """
    tree, mechanisms = arrangement.tree, arrangement.mechanisms
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


def reset_refusal(state: State, recovery: str, decision: Decision) -> str:
    """Say why a recovery is not reset; "" if it may be.

    Args:
        state: Of the arbiter.
        recovery: Name, as it was typed.
        decision: What would run if nothing were latched.
    """
    if recovery not in state.latched:
        known = recovery in state.desired
        return "it is not latched" if known else "there is no such recovery module"
    if not state.oriented:
        return "not all modules have been heard yet"
    if recovery in decision.recoveries:
        return f"the cause persists: {', '.join(decision.active)} active"
    return ""


# -- recoveries that stay in force although nothing asks for them -------------------------------
# A latched recovery stays until an operator resets it, and a reset is refused while its cause
# persists. An adopted one was found activated by an arbiter that had just started, and stays until
# all modules have been heard. Only a safer recovery takes the place of either.


def keep_latched(decision: Decision, kept: Sequence[RecoveryTrack], arrangement: Arrangement, *,
                 exclusive: bool) -> Decision:
    """Return a decision in which the safest of the kept recoveries stays, or a safer one runs.

    Args:
        decision: Without regard to what is kept.
        kept: Latched and adopted recoveries, at least one. Several are only if one drains under
            another.
        arrangement: Of the system.
        exclusive: No repairs run beneath.
    """
    order, contracts = arrangement.order, arrangement.mechanisms.contracts
    safest = min(kept, key=lambda track: order.number[track.name])
    base = tuple(name for name in decision.recoveries
                 if name == safest.name or order.is_above(name, safest.name)) or (safest.name,)
    others = [name for name in decision.recoveries if name not in base]
    beneath = () if exclusive else tuple(
        name for name in others if contracts[name].kind.repairs
        and arrangement.can_join(name, order.mask(base)))
    why = "is latched until reset" if safest.latched else \
        "was found activated, and not all modules have been heard yet"
    return replace(decision, recoveries=base + beneath, rejected=decision.rejected + tuple(
        (name, f"{safest.name} {why}") for name in others if name not in beneath))
