"""What goes into the arbiter, what comes out of it, and what it knows in between."""

from __future__ import annotations

import msgspec
from msgspec.structs import replace

from rampart.manager.arbitration.detection_track import DetectionHeard, DetectionTrack
from rampart.manager.model.mechanisms import RecoveryPhase
from rampart.manager.strategies.decision import Decision

LONG_AGO_S = -1e12
"""A time before all others; finite, for it is kept."""


class Command(msgspec.Struct, frozen=True):
    """What a recovery module is to do, until told otherwise.

    Attributes:
        recovery: Its name.
        activate: Activate, or release.
        decision: Number of the decision that wants it. A new number is a new order, even if all
            else is the same: the cause has come back and the action is to be taken again.
        nodes: Failed nodes that it is for, as far as detection named them.
        reason: In words.
    """

    recovery: str
    activate: bool
    decision: int
    nodes: tuple[str, ...] = ()
    reason: str = ""


class RecoveryHeard(msgspec.Struct, frozen=True, tag=True):
    """Input: a report of a recovery module, for the decision it last obeyed."""

    recovery: str
    activated: bool
    phase: RecoveryPhase
    decision: int
    reason: str = ""


class RecoveryTrack(msgspec.Struct, frozen=True):
    """One recovery module.

    Attributes:
        command: What it was last told; to be repeated until it is obeyed.
        ordered_s: Since when its deadline runs; once it is released, since when it is.
        cause: Detection modules for which it acts, each with the count of its rises: a cause not
            among these is a new one.
        heard: It was heard since the arbiter started.
        activated: What it last reported.
        phase: What it last reported.
        acknowledged: It has reported to act on `command`. Until then it may be about to.
        draining: It is superseded, and left to finish.
        letting_go: It was released and has not confirmed it; it may hold what it claims.
        adopted: It was found activated by an arbiter that had just started.
        latched: It stays until reset.
        latched_s: Since when; long ago if that is not known. Nothing else changes it.
        failure: Why it counts as failed; "" if it does not.
        failed_for: Mechanisms for whose sake it failed; when none is active, all is forgiven.
    """

    command: Command
    ordered_s: float = 0.0
    cause: frozenset[tuple[str, int]] = frozenset()
    heard: bool = False
    activated: bool = False
    phase: RecoveryPhase = RecoveryPhase.IDLE
    acknowledged: bool = False
    draining: bool = False
    letting_go: bool = False
    adopted: bool = False
    latched: bool = False
    latched_s: float = LONG_AGO_S
    failure: str = ""
    failed_for: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Name of the recovery module."""
        return self.command.recovery

    @property
    def wanted(self) -> bool:
        """Whether it is under orders to be activated, draining included."""
        return self.command.activate

    @property
    def unfinished(self) -> bool:
        """Whether it is, or may be for all the arbiter knows, in the middle of its action.

        An order that is not acknowledged is on its way: to release the module now could reach it
        half-way.
        """
        return self.wanted and (not self.acknowledged or self.phase is RecoveryPhase.ACTING)

    @property
    def in_force(self) -> bool:
        """Whether it has done what was ordered; the error may last after a repair."""
        return (self.wanted and self.acknowledged and not self.failure
                and self.phase in {RecoveryPhase.DONE, RecoveryPhase.DEGRADED})

    def heard_from(self, report: RecoveryHeard, now: float) -> RecoveryTrack:
        """Return the track after a report that arrives at `now`."""
        after = replace(self, heard=True, activated=report.activated, phase=report.phase)
        # A report on an earlier decision does not count for this one.
        current = report.decision == self.command.decision
        if not self.wanted:
            return replace(after, letting_go=False) if current and not report.activated else after
        if report.activated:
            failed = current and report.phase is RecoveryPhase.FAILED and not self.failure
            return replace(after, acknowledged=current, failure=(
                report.reason or "it reports failure") if failed else self.failure)
        if self.acknowledged and not self.draining:
            # It was at work and is idle now: it was respawned. Being done earlier earns it the
            # whole deadline; dying half-way does not, or a crash loop would never be found out.
            finished = self.phase is not RecoveryPhase.ACTING
            return replace(
                after, acknowledged=False, ordered_s=now if finished else self.ordered_s)
        return after


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
            escalation and latching, and `rejected` names the others.
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
        recoveries: One track for each recovery module, in the same way.
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
