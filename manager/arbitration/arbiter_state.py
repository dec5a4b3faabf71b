"""Inputs, outputs and state of the arbiter."""

from __future__ import annotations

import math

import msgspec
from msgspec.structs import replace

from rampart.manager.arbitration.detection_track import DetectionHeard, DetectionTrack
from rampart.manager.model.mechanisms import Clears, RecoveryPhase
from rampart.manager.strategies.decision import Decision

LONG_AGO_S = -1e12
"""A time before all others; finite, because it is stored."""


class Command(msgspec.Struct, frozen=True):
    """A command to a recovery module, valid until the next one.

    `nodes` are the failed nodes that detection modules named. A new number of the `decision` is a
    new order to act, even if all else is equal: the cause has come back.
    """

    recovery: str
    activate: bool
    decision: int
    nodes: tuple[str, ...] = ()
    reason: str = ""


class RecoveryHeard(msgspec.Struct, frozen=True, tag=True):
    """Input: a report of a recovery module, on the decision that it last obeyed."""

    recovery: str
    activated: bool
    phase: RecoveryPhase
    decision: int
    reason: str = ""


class RecoveryTrack(msgspec.Struct, frozen=True):
    """One recovery module.

    Attributes:
        command: The last command, repeated until it is obeyed.
        ordered_s: Start of its deadline, or the time of its release.
        cause: Detection modules for which it acts, each with its count of rises, by which a new
            cause is recognized.
        heard: It has reported since the arbiter started.
        activated: Whether it is activated, by its last report.
        phase: Phase in its last report.
        acknowledged: It has reported to act on `command`; before, it may be about to.
        draining: It is superseded, and finishes first.
        letting_go: It was released and has not confirmed it, so it may still hold its claims.
        adopted: It was activated when the arbiter started.
        latched: It stays until it is reset.
        latched_s: Time of latching; long ago if unknown.
        failure: Why it counts as failed; "" if it does not.
        failed_for: Mechanisms for which it failed; when none is active, the failure is cleared.
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
        """Whether it acts, or may act because an order that it has not acknowledged is on its way.

        A release now could reach it in the middle of its action.
        """
        return self.wanted and (not self.acknowledged or self.phase is RecoveryPhase.ACTING)

    @property
    def in_force(self) -> bool:
        """Whether it has done what was ordered; the error may outlast a repair."""
        return (self.wanted and self.acknowledged and not self.failure
                and self.phase in {RecoveryPhase.DONE, RecoveryPhase.DEGRADED})

    def heard_from(self, report: RecoveryHeard, now: float) -> RecoveryTrack:
        """Return the track after a report that arrives at `now`."""
        after = replace(self, heard=True, activated=report.activated, phase=report.phase)
        # A report on an earlier decision says nothing about this one.
        current = report.decision == self.command.decision
        if not self.wanted:
            return replace(after, letting_go=False) if current and not report.activated else after
        if report.activated:
            failed = current and report.phase is RecoveryPhase.FAILED and not self.failure
            return replace(after, acknowledged=current, failure=(
                report.reason or "it reports failure") if failed else self.failure)
        if self.acknowledged and not self.draining:
            # It was respawned. If it had finished, its deadline starts again. If it died while
            # acting, the deadline goes on, or a crash loop would never count as a failure.
            finished = self.phase is not RecoveryPhase.ACTING
            return replace(
                after, acknowledged=False, ordered_s=now if finished else self.ordered_s)
        return after


class Held(msgspec.Struct, frozen=True):
    """A mechanism that stays active when its error is gone.

    Attributes:
        mechanism: Its name.
        recoveries: Recoveries that it runs; a reset of one of them clears it.
        clears: What ends it.
        since_s: When it became active.
        seen_s: When its error was last detected.
    """

    mechanism: str
    recoveries: tuple[str, ...]
    clears: Clears
    since_s: float
    seen_s: float


class ResetAsked(msgspec.Struct, frozen=True, tag=True):
    """Input: an operator request, made at `stamp_s`, to release a latched recovery."""

    recovery: str
    by: str = ""
    stamp_s: float = math.inf


class Tick(msgspec.Struct, frozen=True, tag=True):
    """Input: nothing but time has passed."""


Input = DetectionHeard | RecoveryHeard | ResetAsked | Tick


class DecisionMade(msgspec.Struct, frozen=True, tag=True):
    """Output: a decision as it is executed. `Arbiter.explain` adds the certificate.

    Attributes:
        number: Counts up; commands refer to it.
        decision: The strategy's decision after escalation and latching; `rejected` names the
            recoveries that these removed.
        detected_s: When the youngest of its causes was detected.
        chosen: The strategy's decision.
    """

    number: int
    decision: Decision
    detected_s: float
    chosen: Decision


class ShadowDiffered(msgspec.Struct, frozen=True, tag=True):
    """Output: the shadow `strategy` would have decided otherwise than decision `number`.

    `taken` are the recoveries of the active strategy.
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
    """The whole state of the arbiter.

    Attributes:
        detections: One track for each detection module, in declared sequence.
        recoveries: One track for each recovery module, likewise.
        number: Number of the last decision.
        decision: The last decision, as executed.
        started_s: When the arbiter started.
        oriented: Every module has reported, or the grace time has passed; adoption is over.
        since: Active mechanisms, each with the time since when it has its turn.
        late: Mechanisms whose recovery has not ended the error within its patience.
        held: Mechanisms that stay active when their error is gone.
    """

    detections: tuple[DetectionTrack, ...]
    recoveries: tuple[RecoveryTrack, ...]
    number: int
    decision: Decision
    started_s: float
    oriented: bool = False
    since: tuple[tuple[str, float], ...] = ()
    late: frozenset[str] = frozenset()
    held: tuple[Held, ...] = ()

    @property
    def desired(self) -> dict[str, Command]:
        """The command of each recovery module, which the manager keeps repeating."""
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
        """Names of the recovery modules that are under orders, letting go or latched."""
        latched = self.latched
        return tuple(track.name for track in self.recoveries
                     if track.wanted or track.letting_go or track.name in latched)

    @property
    def latched(self) -> tuple[str, ...]:
        """Names of the recovery modules that are latched, or run for a mechanism that is."""
        kept = {name for held in self.held if held.clears is not Clears.BY_ITSELF
                for name in held.recoveries}
        return tuple(track.name for track in self.recoveries
                     if track.latched or track.name in kept)
