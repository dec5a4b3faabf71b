"""What the arbiter wants of one recovery module, and what it knows of it."""

from __future__ import annotations

import msgspec
from msgspec.structs import replace

from rampart.manager.model.mechanisms import RecoveryPhase

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
        """Whether it has done what it was told; for a repair that says nothing of the error."""
        return (self.wanted and self.acknowledged and not self.failure
                and self.phase in {RecoveryPhase.DONE, RecoveryPhase.DEGRADED})

    @property
    def is_at_rest(self) -> bool:
        """Whether nothing is wanted of it, expected of it or held against it."""
        return not (self.command.activate or self.letting_go or self.latched or self.adopted
                    or self.failure)


def hear(track: RecoveryTrack, report: RecoveryHeard, now: float) -> RecoveryTrack:
    """Take in a report that arrives at `now`."""
    after = replace(track, heard=True, activated=report.activated, phase=report.phase)
    # One on an earlier decision says nothing about this one.
    current = report.decision == track.command.decision
    if not track.wanted:
        return replace(after, letting_go=False) if current and not report.activated else after
    if report.activated:
        failed = current and report.phase is RecoveryPhase.FAILED and not track.failure
        return replace(after, acknowledged=current, failure=(
            report.reason or "it reports failure") if failed else track.failure)
    if track.acknowledged and not track.draining:
        # It was at work and is idle now: it was respawned. Being done earlier earns it the whole
        # deadline; dying half-way does not, or a crash loop would never be found out.
        finished = track.phase is not RecoveryPhase.ACTING
        return replace(after, acknowledged=False, ordered_s=now if finished else track.ordered_s)
    return after
