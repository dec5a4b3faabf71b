"""The contract of fault tolerance: messages of detection, recovery, manager and supervision.

One struct for each message, SI units; times are simulated seconds. Header data (source,
incarnation, sequence, stamp) is not in these structs: the bus adds it
(`rampart.actors.bus.envelope`). Every field is bounded by the types of `rampart.actors.bus.bounds`:
a payload beyond the bounds never reaches an actor.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated

import msgspec

from rampart.actors.bus.bounds import (
    Count,
    Document,
    Explained,
    Incarnation,
    Lasting,
    Many,
    Name,
    Names,
    Pid,
    Seconds,
    Text,
    Texts,
)
from rampart.actors.bus.messages import ON_TIME, Injection, Message
from rampart.manager.model.mechanisms import RecoveryPhase

LARGEST_STATE_BYTES = 64 << 10
"""Largest state that a node may keep: thirty times the usual size."""

KeptBytes = Annotated[bytes, msgspec.Meta(max_length=LARGEST_STATE_BYTES)]


class Holds(Message, frozen=True):
    """Unknown holders of the brake or of an order to the pilot: not recovery modules of the system.

    `what` is held. `holders` are obeyed until they, or an operator in their place, release it.
    """

    what: Name
    holders: Names


class DetectionState(StrEnum):
    """State of a detection module (paper, figure 4)."""

    IDLE = "idle"
    ACTIVE = "active"


class DetectionReport(Message, frozen=True):
    """State of one detection module; `nodes` names the failed nodes where that is the subject."""

    state: DetectionState
    reason: Text
    nodes: Names
    since_s: Seconds


class RecoveryState(StrEnum):
    """State of a recovery module (paper, figure 4)."""

    IDLE = "idle"
    ACTIVATED = "activated"


class RecoveryCommand(Message, frozen=True):
    """What the manager orders one recovery module to do, repeated until it is reported done."""

    activate: bool
    decision: Count
    nodes: Names
    reason: Text


class RecoveryReport(Message, frozen=True):
    """State of one recovery module, for the decision it last obeyed."""

    state: RecoveryState
    phase: RecoveryPhase
    decision: Count
    reason: Text


class Decided(Message, frozen=True):
    """What a strategy decides."""

    decision: Count
    strategy: Name
    active: Names
    rule: Count
    recoveries: Names


class DecisionRecord(Decided, frozen=True):
    """A decision with its certificate: rule is the block 1 to 4 of safety-first, 0 for no fault."""

    path: Texts
    rejected: Explained
    detected_s: Seconds


class AdaptationRequest(Message, frozen=True):
    """Asks the manager to change a mechanism while running (`manager.spec.adaptation.Change`).

    `values` is a JSON object. The answer carries the same `request`.
    """

    request: Name
    action: Name
    name: Name
    values: Document
    by: Name


class AdaptationAnswer(Message, frozen=True):
    """Whether a change was made, and why not; `version` counts the changes made in this run."""

    request: Name
    accepted: bool
    reason: Text
    version: Count


class AdaptedSystem(Message, frozen=True):
    """The system as it was changed; `document` is its whole spec as a JSON object."""

    version: Count
    change: Text
    by: Name
    document: Document


class StubTrigger(Message, frozen=True):
    """Makes the stand-in for detection module `name` active or idle."""

    name: Name
    active: bool
    reason: Text


class ShadowRecord(Decided, frozen=True):
    """A decision that the strategy in shadow would have taken instead of decision `decision`."""

    taken: Names


class DetectionView(Message, frozen=True):
    """What the manager believes about a detection module (it holds a flapping one active)."""

    name: Name
    active: bool
    reason: Text
    nodes: Names


class ManagerStatus(Message, frozen=True):
    """The manager's view, and by its regularity the proof that the manager works."""

    active: Names
    silent: Names
    activated: Names
    latched: Names
    strategy: Name
    decision: Count
    detections: Many[DetectionView] = ()


RESET_REFUSED = "reset refused"
"""Context of the manager's error report about a reset that it refuses; the offender is its name."""


class Reset(Message, frozen=True):
    """Operator's word to release a latched recovery, e.g. the emergency stop."""

    recovery: Name
    by: Name


class NodeState(StrEnum):
    """State of a node's process as the supervisor sees it."""

    STARTING = "starting"
    RUNNING = "running"
    CRASHED = "crashed"
    STOPPED = "stopped"
    WEDGED = "wedged"
    GIVEN_UP = "given up"
    UNREACHABLE = "unreachable"


class NodeInfo(Message, frozen=True, omit_defaults=True):
    """One row of the supervisor's table.

    `late_s` is the greatest lateness of its loop in the last half or whole second, simulated
    seconds; left out for none. `host` is where it runs; "" is the first. `failing`: unstable, its
    processes end again and again. `heard_s` is the stamp of its last heartbeat, which carries the
    numbers of refused payloads and overflows. `next_attempt_s`: when its next start is due.
    """

    name: Name
    kind: Name
    pid: Pid
    state: NodeState
    incarnation: Incarnation
    restarts: Count
    late_s: Seconds = ON_TIME
    host: Name = ""
    failing: bool = False
    heard_s: Seconds = 0.0
    rejected_payloads: Count = 0
    overflowed: Count = 0
    next_attempt_s: Seconds = 0.0


class NodeTable(Message, frozen=True):
    """All nodes of the system."""

    nodes: Many[NodeInfo]


class KeptState(Message, frozen=True):
    """The newest state of a node that a host holds; incarnation and generation are 0 for none.

    `issued` is the highest incarnation of the node that is known there. `final`: no process of the
    node runs there any more, and this is the last state.
    """

    node: Name
    incarnation: Incarnation
    generation: Count
    version: Count
    failures: Count
    state: KeptBytes
    issued: Incarnation
    final: bool


class Checkpoints(Message, frozen=True):
    """States that a host holds of nodes that two hosts may run: all, or the changed ones."""

    run: Name
    kept: Many[KeptState]


class RespawnRequest(Message, frozen=True):
    """A request of a recovery module or the manager: kill a process, if it runs, and restart it."""

    request: Count
    node: Name
    failed_incarnation: Incarnation
    by: Name


class SignalOrder(Message, frozen=True):
    """An order to signal a node's process, carried out once; `signal` is as for `kill-node`."""

    order: Name
    node: Name
    signal: Name


class ProcessEvent(Message, frozen=True):
    """Something happened to a process: crashed, stopped, wedged, respawned, refused, given up.

    And *signalled*, `by` the id of the order; *unstable* after each end while its processes end
    again and again, and then *stable*.
    """

    node: Name
    event: Name
    pid: Pid
    incarnation: Incarnation
    by: Name
    detail: Text

    @property
    def news(self) -> str:
        """Return "clear" or "fault"; "" for routine events and repetitions."""
        if self.event in _ROUTINE or self.detail == "already":
            return ""
        return "clear" if self.event in _GOOD_NEWS else "fault"


class ProgramEnd(Message, frozen=True):
    """The program of a command has ended, or could not be started; its node's process `pid` stays.

    Repeated with each heartbeat until the supervisor answers.
    """

    pid: Pid
    detail: Text


FAILURES = {"crashed": "gone", "stopped": "stopped", "wedged": "hung", "given up": "given up"}
"""Events after which no process of the node works, each with the state of the last one."""

NEW_PROCESSES = ("started", "respawned")
"""Events of a process that exists and has not worked yet."""

_ROUTINE = ("started", "running")
_GOOD_NEWS = ("stable", "respawned", "resumed", "adopted", "back")

_Injections = Annotated[tuple[Injection, ...], msgspec.Meta(max_length=64)]


class FaultOrder(Message, frozen=True):
    """A fault that does not disturb a topic: a message on `topic`, as a JSON object.

    The fields `injection` and `duration_s` of its type are filled in when it is ordered; a duration
    of 0 ends it. The node that carries it out reports it as an injection.
    """

    topic: Name
    document: Document


_FaultOrders = Annotated[tuple[FaultOrder, ...], msgspec.Meta(max_length=64)]


class NamedFault(Message, frozen=True):
    """A fault that the operator's page can order by name.

    `duration_s` is its default duration, simulated seconds; None for permanent.
    """

    name: Name
    title: Text
    group: Name
    duration_s: Lasting | None
    injections: _Injections = ()
    orders: _FaultOrders = ()
