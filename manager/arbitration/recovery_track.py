"""What the arbiter wants of one recovery module, and what it knows of it."""

from __future__ import annotations

from enum import StrEnum

import msgspec


class Phase(StrEnum):
    """How far an activated recovery is; the values are those of its reports on the bus."""

    IDLE = "idle"
    ACTING = "acting"
    DONE = "done"
    DEGRADED = "degraded"
    FAILED = "failed"


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
        failure: Why it counts as failed; "" if it does not.
        failed_for: Mechanisms for whose sake it failed; when none is active, all is forgiven.
    """

    command: Command
    ordered_s: float = 0.0
    cause: frozenset[tuple[str, int]] = frozenset()
    heard: bool = False
    activated: bool = False
    phase: Phase = Phase.IDLE
    acknowledged: bool = False
    draining: bool = False
    letting_go: bool = False
    adopted: bool = False
    latched: bool = False
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
        return self.wanted and (not self.acknowledged or self.phase is Phase.ACTING)

    @property
    def is_at_rest(self) -> bool:
        """Whether nothing is wanted of it, expected of it or held against it."""
        return not (self.command.activate or self.letting_go or self.latched or self.adopted
                    or self.failure)


def report(track: RecoveryTrack, now: float, *, activated: bool, phase: Phase, decision: int,
           reason: str) -> RecoveryTrack:
    """Take in a report that arrives at `now`."""
    replace = msgspec.structs.replace
    after = replace(track, heard=True, activated=activated, phase=phase)
    if not track.wanted:
        if track.letting_go and not activated and decision == track.command.decision:
            after = replace(after, letting_go=False)
        return after
    if activated:
        # A report on an earlier decision says nothing about this one.
        acknowledged = decision == track.command.decision
        after = replace(after, acknowledged=acknowledged)
        if acknowledged and phase is Phase.FAILED and not track.failure:
            after = replace(after, failure=reason or "it reports failure")
        return after
    if track.acknowledged and not track.draining:
        # It was at work and is idle now: it was respawned. Being done earlier earns it the whole
        # deadline; dying half-way does not, or a crash loop would never be found out.
        finished = track.phase is not Phase.ACTING
        return replace(after, acknowledged=False, ordered_s=now if finished else track.ordered_s)
    return after
