"""RM3 and RM4: respawn control nodes, respawn non-control nodes (paper, table II).

Both do the same; what differs is in the nodes: a control node comes back from its checkpoint
(backward recovery), a memoryless one needs none (masking).
"""

from __future__ import annotations

from typing import Any

from rampart.actors.bus import topics as bus_topics
from rampart.actors.bus.messages import Heartbeat
from rampart.actors.bus.topic import Topic
from rampart.actors.ftm import topics
from rampart.actors.ftm.messages import ProcessEvent, RecoveryCommand, RespawnRequest
from rampart.actors.recovery.module import RecoveryModule
from rampart.actors.recovery.respawn_core import RespawnCore
from rampart.actors.runtime.actor import Context, Header, on
from rampart.actors.runtime.parameters import NodeNames

_REQUESTS_PER_LIFE = 1_000_000


class Respawn(RecoveryModule):
    """Has the supervisor respawn the nodes that a command names, and waits until they are heard."""

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
        self._core = RespawnCore(self.parameters.nodes,
                                 context.incarnation * _REQUESTS_PER_LIFE, self.clock.now())

    @classmethod
    def names(
        cls, topic: Topic[Any], name: str, parameters: Parameters
    ) -> tuple[str, ...] | None:
        """Hear the heartbeats of its nodes."""
        if topic is bus_topics.HEARTBEAT:
            return parameters.nodes
        return super().names(topic, name, parameters)

    @classmethod
    def watches(cls, name: str, parameters: Parameters) -> tuple[str, ...]:  # noqa: ARG003
        """Watch the life of its nodes, to know which incarnation has failed."""
        return parameters.nodes

    def act(self, command: RecoveryCommand, *, renewed: bool) -> None:
        """Ask for the nodes that the command names."""
        if self._core.order(command.nodes, self.clock.now(), renewed=renewed):
            self._send_requests()
            self.resume(command.reason)
        self._settle()

    def let_go(self) -> None:
        """Forget the nodes: they are back, or somebody else's concern."""
        self._core.release()

    def repeat(self) -> None:
        """Repeat what the supervisor has not answered."""
        if self.activated:
            self._core.retry(self.clock.now())
            self._settle()

    def unfinished(self) -> str:
        """Name the nodes that are not back."""
        return ", ".join(self._core.pending)

    def on_peer(self, node: str, incarnation: int, alive: bool) -> None:
        """See a process come or go."""
        self._core.peer(node, incarnation, alive, self.clock.now())
        self._settle()

    @on(bus_topics.HEARTBEAT)
    def heartbeat(self, _message: Heartbeat, header: Header) -> None:
        """Hear that a node works."""
        self._core.beat(header.source, header.incarnation, header.stamp, self.clock.now())
        self._settle()

    @on(topics.PROCESS_EVENT)
    def process_event(self, message: ProcessEvent, _header: Header) -> None:
        """Hear what the supervisor did."""
        self._core.event(message.node, message.event, message.incarnation, message.detail,
                         self.clock.now())
        self._settle()

    def _send_requests(self) -> None:
        for ask in self._core.take_requests():
            self.publish(topics.RESPAWN, RespawnRequest(
                ask.request, ask.node, ask.failed_incarnation, self.name))

    def _settle(self) -> None:
        self._send_requests()
        if not self.activated:
            return
        if self._core.problem:
            self.fail(self._core.problem)
        elif not self._core.pending:
            back = self._core.back
            self.succeed(f"{', '.join(back)} back" if back else "no node was named")
