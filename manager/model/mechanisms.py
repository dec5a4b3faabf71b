"""The fault-tolerance mechanisms, FTMx(DMy, RMz), and the contracts of recoveries.

A mechanism joins a detection module to a recovery module, or gates over several of them. It is
*active* if its detection module is (or its gate holds), and *activated* if its recovery module is
(paper, section III-B). Two mechanisms may share a recovery: FTM2 and FTM3 both run RM2.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence, Set
from enum import StrEnum
from itertools import chain

import msgspec

from rampart.manager.model.gates import detection_gate, recovery_gate
from rampart.manager.model.order import UnknownElementError


class RecoveryKind(StrEnum):
    """How a recovery handles an error (Avizienis, Laprie, Randell, Landwehr 2004)."""

    FORWARD = "forward"
    """Brings the robot to a new, safe state, possibly degraded: stopped, or driven by hand."""
    BACKWARD = "backward"
    """Returns to a checkpoint from before the error."""
    MASKING = "masking"
    """Continues the service, as the paper's RM4 does."""

    @property
    def repairs(self) -> bool:
        """Whether the recovery removes the cause, so that its detection must become idle."""
        return self is not RecoveryKind.FORWARD


class RecoveryPhase(StrEnum):
    """Progress of an activated recovery; only `ACTING` must not be cut off."""

    IDLE = "idle"
    ACTING = "acting"
    DONE = "done"
    DEGRADED = "degraded"
    FAILED = "failed"


class Clears(StrEnum):
    """What ends a mechanism whose error is gone."""

    BY_ITSELF = "by itself"
    BY_OPERATOR = "by operator"
    NEVER = "never"
    """Only a new run ends it."""


class Contract(msgspec.Struct, frozen=True):
    """What a recovery module promises the arbiter.

    Attributes:
        name: Name of the recovery module.
        kind: How it recovers.
        claims: Resources that it needs for itself; two recoveries that share one never act at
            the same time.
        interruptible: It may be released while it is acting; otherwise it finishes first.
        latched: It stays in force until an operator resets it, even when the cause is gone.
        excused_by: Detection modules of conditions that explain its causes, such as an overload of
            the machine. An activation meanwhile does not latch.
        deadline_s: Longest time from command to done, and for a repair until the cause is gone.
        escalate_to: Recovery to run if this one fails; "" for that of the mechanism above.
        needs: Nodes or resources that it needs. While a detection module reports a node among
            them failed, the recovery counts as failed too.
        disables: Nodes or resources that cannot be used while it is in force.
    """

    name: str
    kind: RecoveryKind = RecoveryKind.FORWARD
    claims: frozenset[str] = frozenset()
    interruptible: bool = False
    latched: bool = False
    deadline_s: float = 2.0
    escalate_to: str = ""
    needs: frozenset[str] = frozenset()
    disables: frozenset[str] = frozenset()
    excused_by: frozenset[str] = frozenset()


class Mechanism(msgspec.Struct, frozen=True):
    """FTMx(DMy, RMz); `detect` and `recover` are gates in text (`rampart.manager.model.gates`).

    Attributes:
        patience_s: How long its recovery may take before the next barrier has to act.
        explains: Mechanisms whose detections are its consequences. They do not count while its
            detection modules report, not while these are merely silent.
        clears: What ends it; until then it stays active although its error is gone.
        clear_after_s: How long its error must have been gone, in addition to the hold.
    """

    name: str
    detect: str
    recover: str
    patience_s: float = math.inf
    explains: frozenset[str] = frozenset()
    clears: Clears = Clears.BY_ITSELF
    clear_after_s: float = 0.0

    @property
    def outlasts(self) -> bool:
        """Whether it stays active when its error is gone."""
        return self.clears is not Clears.BY_ITSELF or self.clear_after_s > 0


class Mechanisms:
    """All mechanisms of a system, by their names and by those of their modules.

    Args:
        mechanisms: The mechanisms, in declared sequence.
        contracts: Contracts of all recoveries, also of those that only escalation runs.

    Attributes:
        recover: Mechanism → recoveries of its first alternative.
        detect: Mechanism → detection modules in its gate.
        users: Recovery → mechanisms that may run it.
        causes: Recovery → detection modules that it answers to.
        repairs: Detection module → recoveries that answer to it, if all of them repair.
        explaining: The mechanisms that explain others.
        outlasting: The mechanisms that stay active when their error is gone.

    Raises:
        GateError: A gate cannot be read.
    """

    def __init__(self, mechanisms: Sequence[Mechanism], contracts: Sequence[Contract]) -> None:
        self.by_name = {mechanism.name: mechanism for mechanism in mechanisms}
        self.contracts = {contract.name: contract for contract in contracts}
        self._alternatives = {m.name: tuple(recovery_gate(m.recover).alternatives())
                              for m in mechanisms}
        self._gates = {m.name: detection_gate(m.detect) for m in mechanisms}
        self.recover = {name: ways[0] for name, ways in self._alternatives.items()}
        self.detect = {name: gate.names for name, gate in self._gates.items()}
        self.names = tuple(self.by_name)
        self.detections = tuple(dict.fromkeys(chain.from_iterable(self.detect.values())))
        self.recoveries = tuple(self.contracts)
        self._number = {name: index for index, name in enumerate(self.names)}
        self.users: dict[str, set[str]] = {recovery: set() for recovery in self.recoveries}
        self.causes: dict[str, set[str]] = {recovery: set() for recovery in self.recoveries}
        run_for: dict[str, list[str]] = {detection: [] for detection in self.detections}
        for name, ways in self._alternatives.items():
            for recovery in chain.from_iterable(ways):
                self.users[recovery].add(name)
                self.causes[recovery].update(self.detect[name])
            for detection in self.detect[name]:
                run_for[detection] += self.recover[name]
        self.explaining = tuple(m.name for m in mechanisms if m.explains)
        self.outlasting = frozenset(m.name for m in mechanisms if m.outlasts)
        self.repairs = {detection: run for detection, run in run_for.items()
                        if all(self.contracts[recovery].kind.repairs for recovery in run)}

    def sort(self, names: Iterable[str]) -> tuple[str, ...]:
        """Return mechanism names once each, in the declared sequence.

        Raises:
            UnknownElementError: A name is unknown.
        """
        try:
            return tuple(sorted(set(names), key=self._number.__getitem__))
        except KeyError as error:
            raise UnknownElementError(f"unknown mechanism {error.args[0]!r}; "
                                      f"known: {', '.join(self.names)}") from None

    def detected_by(self, active_detections: Iterable[str], silent: Iterable[str] = ()
                    ) -> tuple[str, ...]:
        """Return the mechanisms that are active if these modules are (`silent` ones included)."""
        active, mute = set(active_detections), set(silent)
        if not active:
            return ()
        return tuple(name for name, gate in self._gates.items() if gate.holds(active, mute))

    def unexplained(self, active: tuple[str, ...], reported: Set[str]) -> tuple[str, ...]:
        """Return the active mechanisms that no other mechanism explains.

        `reported` are the modules that are active by their report, not only by their silence.
        """
        if not self.explaining:
            return active
        explained = frozenset().union(*(
            self.by_name[name].explains for name in self.explaining
            if name in active and self._gates[name].holds(reported)))
        return tuple(name for name in active if name not in explained) if explained else active

    def alternatives(self, mechanism: str) -> tuple[tuple[str, ...], ...]:
        """Return the alternative sets of recoveries of a mechanism, the preferred one first."""
        return self._alternatives[mechanism]

    def overlap(self, one: str, other: str) -> bool:
        """Return whether two recoveries claim a common resource."""
        return not self.contracts[one].claims.isdisjoint(self.contracts[other].claims)

    def harms(self, one: str, other: str) -> frozenset[str]:
        """Return what the recovery `one` disables although `other` needs it."""
        return self.contracts[one].disables & self.contracts[other].needs
