"""DM4, DM5 and DM7: crash of a control node, a non-control node, the localization node."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rampart.actors.bus import messages as m
from rampart.actors.bus import topics
from rampart.actors.bus.topic import Topic
from rampart.actors.detection.module import DetectionModule
from rampart.actors.detection.watchdog_core import WatchdogCore
from rampart.actors.runtime.actor import Context, Header, on
from rampart.actors.runtime.parameters import amount


class Watchdog(DetectionModule):
    """Active while one of the nodes it watches is dead, stopped or wedged.

    Parameters:
        watch: names of the nodes.
        timeout_s: a node without a heartbeat for so long has failed, s.

    The first heartbeats of a starting system may take the spec's `startup_grace_s`. A respawned
    module joins a running system: for it the timeout itself is the grace.
    """

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        timeout_s = amount(self.parameters, "timeout_s", 0.5)
        self.monitor = self.judged_by(WatchdogCore(
            watched_nodes(self.parameters), timeout_s, self.clock.now(),
            self.grace_s(timeout_s), known=self.first_life))

    @classmethod
    def names(
        cls, topic: Topic[Any], name: str, parameters: Mapping[str, Any]  # noqa: ARG003
    ) -> tuple[str, ...] | None:
        """Hear the heartbeats of the watched nodes."""
        return watched_nodes(parameters)

    @classmethod
    def watches(cls, name: str, parameters: Mapping[str, Any]) -> tuple[str, ...]:  # noqa: ARG003
        """Watch the life of the watched nodes."""
        return watched_nodes(parameters)

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


def watched_nodes(parameters: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the parameter `watch`.

    Raises:
        ValueError: it is no list of names.
    """
    nodes = parameters.get("watch", ())
    if isinstance(nodes, str) or not all(isinstance(n, str) and n for n in nodes) or not nodes:
        raise ValueError(f"parameters.watch = {nodes!r}: must be a list of node names")
    return tuple(nodes)
