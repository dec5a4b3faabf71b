"""DM4, DM5 and DM7: crash of a control node, a non-control node, the localization node.

A watchdog has two independent ways. The supervisor of the node's host publishes what the kernel
shows: the process has ended, is stopped, or is silent although it could run. And the module itself
receives the heartbeats: after twice the timeout without one the node has failed, whatever the
supervisor publishes, also while that is dead. Twice, because the supervisor is patient with a node
that only waits for a processor (`rampart.actors.machine.patience`).

Incarnations distinguish the processes of a node. The end of one may be reported when the next one
works already, and a heartbeat of the old one may arrive after that report; neither counts for the
new one. Only a heartbeat proves that a node is back. A node that its supervisor calls unstable has
failed until that supervisor, or its successor, reports otherwise: each of its processes may work
for a while.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from rampart.actors.bus import messages as m
from rampart.actors.bus import topics
from rampart.actors.bus.topic import Members, Topic
from rampart.actors.detection.module import DetectionModule
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.ftm.messages import FAILURES, NEW_PROCESSES, ProcessEvent
from rampart.actors.ftm.plausible import is_possible
from rampart.actors.runtime.actor import Context, Header, on
from rampart.actors.runtime.parameters import HeartbeatTimeout, NodeNames

_ALONE = 2
"""Timeouts without a heartbeat after which a node has failed, whatever the supervisor publishes."""


@dataclass(slots=True)
class _Watched:
    """State of a watched node, of its newest incarnation."""

    due_s: float
    incarnation: int = 0
    heard: bool = False
    stamp_s: float = -math.inf
    failed_s: float = -math.inf
    failure: str = ""
    unstable_by: tuple[str, int] | None = None

    @property
    def why(self) -> str:
        """Why the node has failed; "" if it works."""
        return self.failure or ("unstable, it ends again and again" if self.unstable_by else "")


class WatchdogCore:
    """Active while a node has failed.

    Args:
        nodes: The watched nodes.
        timeout_s: Time without a heartbeat after which a node has failed, s.
        start_s: Present time.
        grace_s: How long the first heartbeat of a node may take, s.
        known: Whether to report idle before the heartbeats of all nodes.
    """

    def __init__(self, nodes: Iterable[str], timeout_s: float, start_s: float, grace_s: float,
                 *, known: bool = True) -> None:
        self.timeout_s = timeout_s
        self._known = known
        self._watched = {node: _Watched(start_s + grace_s) for node in nodes}

    @property
    def active(self) -> bool:
        """Whether a node has failed."""
        return any(watched.why for watched in self._watched.values())

    @property
    def nodes(self) -> tuple[str, ...]:
        """The failed nodes."""
        return tuple(node for node, watched in self._watched.items() if watched.why)

    @property
    def reason(self) -> str:
        """Failure of each failed node."""
        return "; ".join(f"{node}: {self._watched[node].why}" for node in self.nodes)

    @property
    def known(self) -> bool:
        """Whether each node has sent a heartbeat, or failed."""
        return self._known or all(
            watched.heard or watched.failure for watched in self._watched.values())

    @property
    def due_s(self) -> float:
        """When a heartbeat is overdue."""
        return min((watched.due_s for watched in self._watched.values() if not watched.failure),
                   default=math.inf)

    def beat(self, node: str, incarnation: int, stamp_s: float, now_s: float) -> None:
        """Note a heartbeat sent at `stamp_s`."""
        watched = self._watched.get(node)
        if watched is None or incarnation < watched.incarnation:
            return
        if incarnation > watched.incarnation:
            self._succeed(watched, incarnation)
        elif watched.failure and (stamp_s <= watched.failed_s or not is_possible(stamp_s, now_s)):
            return  # sent before it failed, or at an impossible time
        watched.heard, watched.stamp_s, watched.failure = True, stamp_s, ""
        watched.due_s = now_s + self.timeout_s

    def event(self, node: str, event: str, incarnation: int, stamp_s: float, now_s: float,
              *, by: tuple[str, int] = ("", 1)) -> None:
        """Note an event of a process that the supervisor `by` published at `stamp_s`."""
        watched = self._watched.get(node)
        if watched is None or incarnation < watched.incarnation:
            return
        if event == "unstable":
            watched.unstable_by = by
        elif event == "stable" or by != watched.unstable_by:  # a new supervisor starts to count
            watched.unstable_by = None
        if event in NEW_PROCESSES and incarnation > watched.incarnation:
            first = watched.incarnation == 0
            self._succeed(watched, incarnation)
            if not first:  # at the start the longer grace still runs
                watched.due_s = now_s + self.timeout_s
        elif event in FAILURES and (
                incarnation > watched.incarnation or stamp_s >= watched.stamp_s):
            watched.incarnation, watched.failed_s = incarnation, stamp_s
            watched.failure = f"process of incarnation {incarnation} is {FAILURES[event]}"

    def expire(self, now_s: float) -> None:
        """Conclude from the time without a heartbeat."""
        for watched in self._watched.values():
            if now_s >= watched.due_s and not watched.failure:
                watched.failed_s = watched.stamp_s
                watched.failure = (f"no heartbeat for {self.timeout_s:g} s" if watched.heard
                               else "never heard")

    @staticmethod
    def _succeed(watched: _Watched, incarnation: int) -> None:
        """Expect the next process; a failure stays until its first heartbeat."""
        watched.incarnation, watched.heard = incarnation, False
        watched.stamp_s = watched.failed_s = -math.inf


class Watchdog(DetectionModule):
    """Active while a watched node is dead, stopped or hung."""

    class Parameters(DetectionModule.Parameters, frozen=True, kw_only=True):
        """Nodes and timeout.

        Attributes:
            watch: names of the nodes.
            timeout_s: the supervisor's timeout of their heartbeats, s. Here a node has failed after
                twice this time without watched.
        """

        watch: NodeNames
        timeout_s: HeartbeatTimeout = 0.5

    parameters: Parameters

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        timeout_s = _ALONE * self.parameters.timeout_s
        self.monitor = self.judged_by(WatchdogCore(
            self.parameters.watch, timeout_s, self.clock.now(), self.grace_s(timeout_s),
            known=self.first_life))

    @classmethod
    def names(cls, topic: Topic[Any], name: str, parameters: Parameters) -> Members:  # noqa: ARG003
        """Subscribe to the heartbeats of the watched nodes."""
        return parameters.watch if topic is topics.HEARTBEAT else None

    @on(topics.HEARTBEAT)
    def heartbeat(self, _message: m.Heartbeat, header: Header) -> None:
        """Note a heartbeat."""
        self.monitor.beat(header.source, header.incarnation, header.stamp, self.came_s(header))
        self.follow()

    @on(ftm_topics.PROCESS_EVENT)
    def process_event(self, message: ProcessEvent, header: Header) -> None:
        """Note an event that a supervisor has published."""
        self.monitor.event(message.node, message.event, message.incarnation, header.stamp,
                           self.clock.now(), by=(header.source, header.incarnation))
        self.follow()
