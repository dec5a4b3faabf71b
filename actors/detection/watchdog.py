"""DM4, DM5 and DM7: crash of a control node, a non-control node, the localization node."""

from __future__ import annotations

from typing import Any

from rampart.actors.bus import messages as m
from rampart.actors.bus import topics
from rampart.actors.bus.topic import Topic
from rampart.actors.detection.module import DetectionModule, Waiting
from rampart.actors.detection.watchdog_core import WatchdogCore
from rampart.actors.runtime.actor import Context, Header, on
from rampart.actors.runtime.parameters import HeartbeatTimeout, NodeNames


class Watchdog(DetectionModule):
    """Active while one of the nodes it watches is dead, stopped or wedged."""

    class Parameters(Waiting, frozen=True, kw_only=True):
        """Whom it watches.

        Attributes:
            watch: names of the nodes.
            timeout_s: a node without a heartbeat for so long has failed, s.
        """

        watch: NodeNames
        timeout_s: HeartbeatTimeout = 0.5

    parameters: Parameters

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        timeout_s = self.parameters.timeout_s
        self.monitor = self.judged_by(WatchdogCore(
            self.parameters.watch, timeout_s, self.clock.now(),
            self.grace_s(timeout_s), known=self.first_life))

    @classmethod
    def names(
        cls, topic: Topic[Any], name: str, parameters: Parameters  # noqa: ARG003
    ) -> tuple[str, ...] | None:
        """Hear the heartbeats of the watched nodes."""
        return parameters.watch

    @classmethod
    def watches(cls, name: str, parameters: Parameters) -> tuple[str, ...]:  # noqa: ARG003
        """Watch the life of the watched nodes."""
        return parameters.watch

    def on_peer(self, node: str, incarnation: int, alive: bool) -> None:
        """See a process come or go: the fast path to a crash."""
        self.monitor.peer(node, incarnation, alive, self.clock.now())
        self.follow()

    @on(topics.HEARTBEAT)
    def heartbeat(self, _message: m.Heartbeat, header: Header) -> None:
        """Hear that a loop turns."""
        self.monitor.beat(header.source, header.incarnation, header.stamp,
                          self.clock.now())
        self.follow()
