"""DM4, DM5 and DM7: crash of a control node, a non-control node, the localization node.

Two ways, which have nothing in common. The supervisor of the node's host sees what the kernel knows
and publishes it: the process has ended, is stopped, or is silent although it could run. And the
module receives the heartbeats itself: without one for twice the timeout the node has failed,
whatever the supervisor publishes, and also while it is dead. Twice, because the supervisor has the
patience for a node that only waits for a processor (`rampart.actors.machine.patience`).

Processes of a node are told apart by their incarnation. The end of one may be reported when the
next is already at work, and a heartbeat of the old one may arrive after the news of its end;
neither may be believed of the new one. Being back is proved by a heartbeat: a process that exists
does not work yet.
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
"""After so many timeouts without a heartbeat a node has failed though the supervisor has not
published that."""


@dataclass(slots=True)
class _Watched:
    """What is known of a watched node: its newest incarnation and how that one is."""

    due_s: float
    incarnation: int = 0
    heard: bool = False
    stamp_s: float = -math.inf
    failed_s: float = -math.inf
    failure: str = ""


class WatchdogCore:
    """Active while one of the nodes has failed; `nodes` names those.

    Args:
        nodes: the watched nodes.
        timeout_s: a node without a heartbeat for so long has failed, s.
        start_s: now.
        grace_s: how long the first heartbeat of a node may take, s.
        known: whether idle may be claimed before all nodes were heard.
    """

    def __init__(self, nodes: Iterable[str], timeout_s: float, start_s: float, grace_s: float,
                 *, known: bool = True) -> None:
        self.timeout_s = timeout_s
        self._known = known
        self._watched = {node: _Watched(start_s + grace_s) for node in nodes}

    @property
    def active(self) -> bool:
        """Whether a node has failed."""
        return any(one.failure for one in self._watched.values())

    @property
    def nodes(self) -> tuple[str, ...]:
        """The failed nodes."""
        return tuple(node for node, one in self._watched.items() if one.failure)

    @property
    def reason(self) -> str:
        """What happened to each failed node."""
        return "; ".join(
            f"{node}: {one.failure}" for node, one in self._watched.items() if one.failure)

    @property
    def known(self) -> bool:
        """Whether each node was heard, or missed."""
        return self._known or all(one.heard or one.failure for one in self._watched.values())

    @property
    def due_s(self) -> float:
        """When a heartbeat is overdue."""
        return min((one.due_s for one in self._watched.values() if not one.failure),
                   default=math.inf)

    def beat(self, node: str, incarnation: int, stamp_s: float, now_s: float) -> None:
        """Take note of a heartbeat sent at `stamp_s`."""
        one = self._watched.get(node)
        if one is None or incarnation < one.incarnation:
            return
        if incarnation > one.incarnation:
            self._succeed(one, incarnation)
        elif one.failure and (stamp_s <= one.failed_s or not is_possible(stamp_s, now_s)):
            return  # sent before it failed, and under way since; or at an impossible time
        one.heard, one.stamp_s, one.failure = True, stamp_s, ""
        one.due_s = now_s + self.timeout_s

    def event(self, node: str, event: str, incarnation: int, stamp_s: float, now_s: float) -> None:
        """Take note of what the supervisor published of a process at `stamp_s`."""
        one = self._watched.get(node)
        if one is None or incarnation < one.incarnation:
            return
        if event in NEW_PROCESSES and incarnation > one.incarnation:
            first = one.incarnation == 0
            self._succeed(one, incarnation)
            if not first:  # at the very start the grace is longer, and still runs
                one.due_s = now_s + self.timeout_s
        elif event in FAILURES and (incarnation > one.incarnation or stamp_s >= one.stamp_s):
            one.incarnation, one.failed_s = incarnation, stamp_s
            one.failure = f"process of incarnation {incarnation} is {FAILURES[event]}"

    def expire(self, now_s: float) -> None:
        """Conclude from the time that has passed without a heartbeat."""
        for one in self._watched.values():
            if now_s >= one.due_s and not one.failure:
                one.failed_s = one.stamp_s
                one.failure = (f"no heartbeat for {self.timeout_s:g} s" if one.heard
                               else "never heard")

    @staticmethod
    def _succeed(one: _Watched, incarnation: int) -> None:
        """Expect the next process; a failure stays until its first heartbeat."""
        one.incarnation, one.heard = incarnation, False
        one.stamp_s = one.failed_s = -math.inf


class Watchdog(DetectionModule):
    """Active while one of the nodes it watches is dead, stopped or wedged."""

    class Parameters(DetectionModule.Parameters, frozen=True, kw_only=True):
        """Whom it watches.

        Attributes:
            watch: names of the nodes.
            timeout_s: that of their heartbeats in the supervisor, s. Without one for twice as long
                a node has failed here.
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
        """Take note that a loop turns."""
        self.monitor.beat(header.source, header.incarnation, header.stamp, self.came_s(header))
        self.follow()

    @on(ftm_topics.PROCESS_EVENT)
    def process_event(self, message: ProcessEvent, header: Header) -> None:
        """Take note of what the supervisor of a node's host has seen."""
        self.monitor.event(message.node, message.event, message.incarnation, header.stamp,
                           self.clock.now())
        self.follow()
