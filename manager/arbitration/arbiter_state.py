"""What goes into the arbiter, what comes out of it, and what it knows in between."""

from __future__ import annotations

import msgspec

from rampart.manager.arbitration.detection_track import DetectionHeard, DetectionTrack
from rampart.manager.arbitration.recovery_track import Command, RecoveryHeard, RecoveryTrack
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
