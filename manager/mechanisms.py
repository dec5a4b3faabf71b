"""The fault-tolerance mechanisms: FTMx(DMy, RMz), and what a recovery promises.

A mechanism joins one detection module to one recovery module. It is *active* when its detection
module is, and *activated* when its recovery module is (paper, section III-B). Two mechanisms may
share a recovery: FTM2 and FTM3 both stop the robot with RM2.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from enum import StrEnum

import msgspec

from manager.order import UnknownElementError


class RecoveryKind(StrEnum):
    """How a recovery gets rid of an error (Avizienis, Laprie, Randell, Landwehr 2004)."""

    FORWARD = "forward"
    """A new, safe state, possibly degraded: stopped, or driven by hand."""
    BACKWARD = "backward"
    """Back to a checkpoint from before the error."""
    MASKING = "masking"
    """Service goes on as if nothing had happened."""

    @property
    def repairs(self) -> bool:
        """Whether the cause is to be gone afterwards, so that its detection must fall silent."""
        return self is not RecoveryKind.FORWARD


class Contract(msgspec.Struct, frozen=True):
    """What a recovery module promises the arbiter.

    Attributes:
        name: Of the recovery module.
        kind: How it recovers.
        claims: Resources that it needs for itself; two recoveries that share one never act at
            the same time.
        interruptible: May be released while it is acting. False: it is left to finish.
        latched: Stays in force until an operator resets it, even when the cause is gone.
        deadline_s: From command to done (and, for a repair, to the cause being gone).
        escalate_to: Recovery to take when this one fails; "" for that of the mechanism above.
    """

    name: str
    kind: RecoveryKind = RecoveryKind.FORWARD
    claims: frozenset[str] = frozenset()
    interruptible: bool = False
    latched: bool = False
    deadline_s: float = 2.0
    escalate_to: str = ""


class Mechanism(msgspec.Struct, frozen=True):
    """FTMx(DMy, RMz)."""

    name: str
    detect: str
    recover: str


class Mechanisms:
    """All mechanisms of a system, looked up by their name or by that of one of their modules.

    Args:
        mechanisms: In the sequence in which they are shown.
        contracts: Of all recoveries, those included that are only escalated to.

    Raises:
        ValueError: Two of one name, or a recovery without a contract.
    """

    def __init__(self, mechanisms: Sequence[Mechanism], contracts: Sequence[Contract]) -> None:
        self.by_name = {mechanism.name: mechanism for mechanism in mechanisms}
        self.contracts = {contract.name: contract for contract in contracts}
        if len(self.by_name) != len(mechanisms) or len(self.contracts) != len(contracts):
            raise ValueError("two mechanisms or two recoveries have the same name")
        self.recover = {mechanism.name: mechanism.recover for mechanism in mechanisms}
        self.detect = {mechanism.name: mechanism.detect for mechanism in mechanisms}
        for mechanism in mechanisms:
            if mechanism.recover not in self.contracts:
                raise ValueError(f"{mechanism.name} names unknown recovery {mechanism.recover!r}")
        self.names = tuple(self.by_name)
        self.detections = tuple(dict.fromkeys(self.detect.values()))
        self.recoveries = tuple(self.contracts)

    def sort(self, names: Iterable[str]) -> tuple[str, ...]:
        """Return mechanism names once each, in the declared sequence.

        Raises:
            UnknownElementError: One of them is no mechanism.
        """
        wanted = set(names)
        unknown = wanted - self.by_name.keys()
        if unknown:
            raise UnknownElementError(
                f"unknown mechanism {min(unknown)!r}; known: {', '.join(self.names)}")
        return tuple(name for name in self.names if name in wanted)

    def detected_by(self, active_detections: Iterable[str]) -> tuple[str, ...]:
        """Return the mechanisms that are active when these detection modules are."""
        active = set(active_detections)
        return tuple(name for name in self.names if self.detect[name] in active)

    def overlap(self, one: str, other: str) -> bool:
        """Tell whether two recoveries claim a common resource."""
        return not self.contracts[one].claims.isdisjoint(self.contracts[other].claims)
