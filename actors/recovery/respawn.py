"""RM3 and RM4: respawn control nodes, respawn non-control nodes (paper, table II).

Both do the same, and only their nodes differ: a control node continues from its checkpoint
(backward recovery), a stateless one needs none (masking).

For each failed node the module requests a new process from the supervisor, which proves itself by a
heartbeat. A request names the *failed incarnation*, so a repeated or outdated request kills no
working process:

* If the supervisor has published the incarnation as failed, or its heartbeat is overdue, the
  request names it.
* If its heartbeat is recent, the request names the incarnation before. The supervisor, which holds
  the pidfd, respawns the node or answers that it is there. This happens when this module was itself
  respawned and is commanded again, and when a stopped process was continued just in time.
* A detection module that has compared messages may accuse the incarnation of a live node,
  `NAME#INCARNATION`. The request names that incarnation, and no later one.
* If a new process dies, or sends no heartbeat in time, the next request names it. The supervisor
  counts the restarts, and gives up after too many.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum
from typing import Any

from rampart.actors.bus import topics as bus_topics
from rampart.actors.bus.messages import Heartbeat
from rampart.actors.bus.topic import Members, Topic
from rampart.actors.ftm import topics
from rampart.actors.ftm.messages import ProcessEvent, RecoveryCommand, RespawnRequest
from rampart.actors.recovery.module import RecoveryModule
from rampart.actors.runtime.actor import Context, Header, on
from rampart.actors.runtime.parameters import NodeNames

_REQUESTS_PER_INCARNATION = 1_000_000
_BLOCKS = 1 << 32
"""Incarnations after which request numbers repeat, since they have to stay below 2^53."""

_OVERDUE_S, _OVERDUE = 0.25, 0.57
"""Age at which a heartbeat is overdue; in a faster system a share of the heartbeat timeout."""

_START_TIMEOUT_S = 1.0
"""How long a new process may take until its first heartbeat."""


class Stage(Enum):
    """Stage of the respawn of a node."""

    NONE = "not requested"
    ASKED = "requested"
    STARTED = "started"
    BACK = "back"
    FAILED = "failed"


_WAITING = (Stage.ASKED, Stage.STARTED)
_LOST = ("crashed", "stopped", "wedged")


@dataclass(slots=True)
class _Node:
    """State of one node. Times are simulated seconds."""

    beat_s: float
    incarnation: int = 0
    gone_s: float = -math.inf
    stage: Stage = Stage.NONE
    request: int = 0
    failed_incarnation: int = 0
    asked_s: float = 0.0
    started_s: float = 0.0
    problem: str = ""


class RespawnCore:
    """The respawns of one recovery module. Requests wait for `take_requests`.

    Args:
        by: Name of the module.
        nodes: Nodes that it may respawn.
        first_request: Number of the first request.
        start_s: Present time.
        overdue_s: Age at which a heartbeat is overdue.
    """

    def __init__(self, by: str, nodes: Iterable[str], first_request: int, start_s: float,
                 overdue_s: float = _OVERDUE_S) -> None:
        self._by = by
        self._nodes = {name: _Node(beat_s=start_s) for name in nodes}
        self._next_request = first_request
        self._overdue_s = overdue_s
        self._strangers: tuple[str, ...] = ()
        self._requests: list[RespawnRequest] = []

    # -- orders ---------------------------------------------------------------------------------

    def order(self, nodes: Iterable[str], now_s: float, *, renewed: bool) -> bool:
        """Request the nodes that are not requested already.

        Args:
            nodes: Names, perhaps with the accused incarnation, `NAME#INCARNATION`.
            now_s: Present time.
            renewed: Whether it is a new order, which also requests nodes that were given up.

        Returns:
            Whether there is a new request.
        """
        requests = len(self._requests)
        named = tuple(map(accused, nodes))
        self._strangers = tuple(name for name, _ in named if name not in self._nodes)
        for name, wrong in named:
            node = self._nodes.get(name)
            if node is not None and (
                    node.stage is Stage.NONE or (node.stage is Stage.FAILED and renewed) or (
                        node.stage is Stage.BACK and (
                            self._has_failed(node, now_s) or wrong >= node.incarnation > 0))):
                self._ask(name, node, now_s, wrong)
        return len(self._requests) > requests

    def release(self) -> None:
        """Forget all orders."""
        self._strangers = ()
        self._requests.clear()
        for node in self._nodes.values():
            node.stage = Stage.NONE

    def take_requests(self) -> list[RespawnRequest]:
        """Return the requests to send now, each once."""
        requests, self._requests = self._requests, []
        return requests

    # -- events ---------------------------------------------------------------------------------

    def beat(self, name: str, incarnation: int, stamp_s: float, now_s: float) -> None:
        """Note a heartbeat sent at `stamp_s`."""
        node = self._nodes.get(name)
        if node is None or incarnation < node.incarnation:
            return
        if incarnation == node.incarnation and stamp_s <= node.gone_s:
            return  # sent before it died
        node.incarnation, node.beat_s, node.gone_s = incarnation, now_s, -math.inf
        # A heartbeat that was sent before the order proves nothing.
        if node.stage in (Stage.ASKED, Stage.STARTED, Stage.FAILED) \
                and incarnation > node.failed_incarnation and stamp_s >= node.asked_s:
            node.stage = Stage.BACK

    def event(self, name: str, event: str, incarnation: int, detail: str, now_s: float) -> None:
        """Note an event of a process that the supervisor has published."""
        node = self._nodes.get(name)
        if node is None:
            return
        if incarnation > node.incarnation:
            # No heartbeat yet, but not overdue.
            node.incarnation, node.beat_s, node.gone_s = incarnation, now_s, -math.inf
        if event in _LOST and incarnation == node.incarnation:
            node.gone_s = now_s
            if incarnation > node.failed_incarnation and node.stage in _WAITING:
                self._ask(name, node, now_s)
        elif event == "respawned" and node.stage is Stage.ASKED:
            node.stage = Stage.STARTED
            node.started_s = now_s
            node.failed_incarnation = max(node.failed_incarnation, incarnation - 1)
        elif event in ("refused", "given up") and node.stage in _WAITING:
            node.stage = Stage.FAILED
            node.problem = f"{name}: {event}{f', {detail}' if detail else ''}"

    def retry(self, now_s: float) -> None:
        """Repeat unanswered requests; request a new process without a heartbeat again."""
        for name, node in self._nodes.items():
            if node.stage is Stage.ASKED:
                self._request(name, node)
            elif node.stage is Stage.STARTED and now_s - node.started_s >= _START_TIMEOUT_S:
                self._ask(name, node, now_s)

    # -- state ----------------------------------------------------------------------------------

    def accuse(self, name: str) -> str:
        """Return a working node with its newest incarnation, to have it respawned."""
        return f"{name}#{self._nodes[name].incarnation}"

    @property
    def pending(self) -> tuple[str, ...]:
        """Nodes that are requested and neither back nor given up."""
        return tuple(name for name, node in self._nodes.items() if node.stage in _WAITING)

    @property
    def back(self) -> tuple[str, ...]:
        """Nodes that are back."""
        return tuple(name for name, node in self._nodes.items() if node.stage is Stage.BACK)

    @property
    def problem(self) -> str:
        """Why it cannot succeed; "" if it still may."""
        problems = [n.problem for n in self._nodes.values() if n.stage is Stage.FAILED]
        problems += [f"{name}: not among the nodes that this module may respawn"
                     for name in self._strangers]
        return "; ".join(problems)

    def _has_failed(self, node: _Node, now_s: float) -> bool:
        return node.gone_s > -math.inf or now_s - node.beat_s >= self._overdue_s

    def _ask(self, name: str, node: _Node, now_s: float, wrong: int = 0) -> None:
        failed = node.incarnation if self._has_failed(node, now_s) else node.incarnation - 1
        node.request, node.failed_incarnation = self._next_request, max(0, failed, wrong)
        node.stage = Stage.ASKED
        node.asked_s = now_s
        self._next_request += 1
        self._request(name, node)

    def _request(self, name: str, node: _Node) -> None:
        self._requests.append(RespawnRequest(
            node.request, name, node.failed_incarnation, self._by))


def accused(node: str) -> tuple[str, int]:
    """Return name and incarnation of `NAME#INCARNATION`; 0 if it names none."""
    name, _, incarnation = node.partition("#")
    return name, int(incarnation) if incarnation.isdecimal() else 0


class Respawn(RecoveryModule):
    """Has the supervisor respawn the nodes of a command, and waits for their heartbeats."""

    class Parameters(RecoveryModule.Parameters, frozen=True):
        """What it is for.

        Attributes:
            nodes: names of the nodes that it may respawn; those whose `respawn` names it, if left
                out.
        """

        nodes: NodeNames

    parameters: Parameters

    outputs = (*RecoveryModule.outputs, topics.RESPAWN)

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        # A node that is reported as silent is overdue here as well.
        overdue_s = min(_OVERDUE_S, _OVERDUE * context.run.system.timing.heartbeat_timeout_s)
        self._core = RespawnCore(
            self.name, self.parameters.nodes,
            context.incarnation % _BLOCKS * _REQUESTS_PER_INCARNATION,
            self.clock.now(), overdue_s)

    @classmethod
    def names(cls, topic: Topic[Any], name: str, parameters: Parameters) -> Members:
        """Subscribe to the heartbeats of its nodes."""
        if topic is bus_topics.HEARTBEAT:
            return parameters.nodes
        return super().names(topic, name, parameters)

    def act(self, command: RecoveryCommand, *, renewed: bool) -> None:
        """Request the nodes of the command."""
        if self._core.order(command.nodes, self.clock.now(), renewed=renewed):
            self._send_requests()
            self.resume(command.reason)
        self._settle()

    def let_go(self) -> None:
        """Forget the nodes."""
        self._core.release()

    def repeat(self) -> None:
        """Repeat the requests that the supervisor has not answered."""
        if self.activated:
            self._core.retry(self.clock.now())
            self._settle()

    def unfinished(self) -> str:
        """Name the nodes that are not back."""
        return ", ".join(self._core.pending)

    @on(bus_topics.HEARTBEAT)
    def heartbeat(self, _message: Heartbeat, header: Header) -> None:
        """Note a heartbeat."""
        self._core.beat(header.source, header.incarnation, header.stamp, self.came_s(header))
        self._settle()

    @on(topics.PROCESS_EVENT)
    def process_event(self, message: ProcessEvent, _header: Header) -> None:
        """Note an event of the supervisor."""
        self._core.event(message.node, message.event, message.incarnation, message.detail,
                         self.clock.now())
        self._settle()

    def _send_requests(self) -> None:
        for request in self._core.take_requests():
            self.publish(topics.RESPAWN, request)

    def _settle(self) -> None:
        self._send_requests()
        if not self.activated:
            return
        if self._core.problem:
            self.fail(self._core.problem)
        elif not self._core.pending:
            back = self._core.back
            self.succeed(f"{', '.join(back)} back" if back else "no node was named")
