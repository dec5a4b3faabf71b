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
"""Of the state that a node keeps: thirty times what states are. A larger one is refused."""

KeptBytes = Annotated[bytes, msgspec.Meta(max_length=LARGEST_STATE_BYTES)]


class Holds(Message, frozen=True):
    """Who holds the brake, or an order to the pilot, and is no recovery module of the system.

    `what` is held; `holders` are obeyed until they let go, or an operator does for them.
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

    `late_s` is how late its loop was at most in the last half or whole second, simulated
    seconds; left out if none was. `host` is where it runs; "" is the first. `failing`: its last
    processes each worked for a short time only. `heard_s` is the stamp of its last heartbeat, which
    says how many messages it has refused so far, and why.
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


class NodeTable(Message, frozen=True):
    """All nodes of the system."""

    nodes: Many[NodeInfo]


class KeptState(Message, frozen=True):
    """The newest state of a node that a host holds; incarnation and generation are 0 for none.

    `issued` is the highest incarnation of the node that host has issued. `final`: no process of the
    node is there, and this is the last that any has kept.
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
    """States that a host holds of nodes that two hosts may run: all, or those that changed."""

    run: Name
    kept: Many[KeptState]


class RespawnRequest(Message, frozen=True):
    """A request of a recovery module or the manager: kill a process, if it runs, and restart it."""

    request: Count
    node: Name
    failed_incarnation: Incarnation
    by: Name


class SignalOrder(Message, frozen=True):
    """An order to signal the process of a node; the same `order` twice is one.

    `signal` is one that `kill-node` has, such as `KILL`.
    """

    order: Name
    node: Name
    signal: Name


class ProcessEvent(Message, frozen=True):
    """Something happened to a process: crashed, stopped, wedged, respawned, refused, given up.

    And *signalled*, `by` the id of the order.
    """

    node: Name
    event: Name
    pid: Pid
    incarnation: Incarnation
    by: Name
    detail: Text

    @property
    def news(self) -> str:
        """Return "clear" or "fault"; "" of what is routine, or published a second time."""
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
"""Events after which no process of the node works, with what has become of it."""

NEW_PROCESSES = ("started", "respawned")
"""Events that name a process which is there, and has not worked yet."""

_ROUTINE = ("started", "running")
_GOOD_NEWS = ("respawned", "resumed", "adopted", "back")

_Injections = Annotated[tuple[Injection, ...], msgspec.Meta(max_length=64)]


class FaultOrder(Message, frozen=True):
    """A fault that is no disturbance of a topic: a message on `topic`, as a JSON object.

    Its type has the fields `injection` and `duration_s`, filled in when it is ordered; a duration
    of 0 ends it. The node that carries it out reports on it as on an injection.
    """

    topic: Name
    document: Document


_FaultOrders = Annotated[tuple[FaultOrder, ...], msgspec.Meta(max_length=64)]


class NamedFault(Message, frozen=True):
    """A fault that can be ordered by its name: what the launcher offers to the operator's page.

    `duration_s` is how long it lasts unless told otherwise, simulated seconds; None for ever.
    """

    name: Name
    title: Text
    group: Name
    duration_s: Lasting | None
    injections: _Injections = ()
    orders: _FaultOrders = ()
