"""`Overload`: the machine lacks processor time for the system, one cause of many symptoms.

Each heartbeat carries the lateness of its node's loop, and its stamp shows the delay of the bus,
which needs processor time as well. A single late node may be at fault itself. Many late nodes at
once have the machine in common. The kernel's own figure (`/proc/pressure/cpu`) does not show which
programs wait: it is high also when another program takes nothing from the robot.

An overload comes in waves. So it is not over while the nodes still wait for a processor
(`/proc/PID/schedstat`), unless none was late for some time.

This module lacks processor time as well. Its input is late, but the same. If its reports are
missing for too long, the manager takes it for active.
"""

from __future__ import annotations

import math
from typing import Annotated, Any

import msgspec

from rampart.actors.bus import topics as bus_topics
from rampart.actors.bus.messages import Heartbeat
from rampart.actors.bus.topic import Members, Topic
from rampart.actors.detection.finding import Sustained
from rampart.actors.detection.module import DetectionModule
from rampart.actors.runtime.actor import Context, Header, every, on
from rampart.actors.runtime.parameters import NodeNames
from rampart.manager.spec.budget import allowed_late_s
from rampart.manager.spec.tables import NonNegative, Positive

LEAST = 2
"""Fewer late nodes may be at fault themselves."""

_LOOK_S = 0.1
_SAMPLE_S = 0.5

Share = Annotated[float, msgspec.Meta(gt=0, le=1)]


class Overload(DetectionModule):
    """Active while many of the watched nodes are late at once."""

    class Parameters(DetectionModule.Parameters, frozen=True, kw_only=True):
        """Nodes, and limits for many and late.

        Attributes:
            watch: names of the nodes.
            share: share of the nodes that have to be late; two at least.
            late_s: how late, s; by default half the shortest slack of a timeout of the system.
            within_s: for how long a late node counts, s; as long as it was late, if that is longer,
                but not longer than `clear_s`.
            clear_s: how long fewer have to be late before the module is idle again, s ...
            wait_share: ... and as many no longer wait for a processor for this share of the time
            wait_s: ... unless none of it was late for so long, s.
        """

        watch: NodeNames
        share: Share = 0.3
        late_s: Positive | None = None
        within_s: Positive = 0.5
        clear_s: NonNegative = 2.0
        wait_share: Share = 0.1
        wait_s: NonNegative = 10.0

    parameters: Parameters

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        chosen = self.parameters
        self._too_late_s = chosen.late_s or allowed_late_s(context.run.system.timing)
        self._many = max(LEAST, chosen.share * len(chosen.watch))
        self._late_until_s: dict[str, float] = {}
        self._pids: dict[str, int] = {}
        self._waited_s: dict[int, float] = {}
        self._sampled_s = self._was_late_s = -math.inf
        self._may_wait = False
        self._knows_from_s = self.known_after_s(chosen.within_s)
        self.monitor = self.judged_by(Sustained(0.0, chosen.clear_s, self._knows_from_s))

    @classmethod
    def names(cls, topic: Topic[Any], name: str, parameters: Parameters) -> Members:  # noqa: ARG003
        """Subscribe to the heartbeats of the watched nodes."""
        return parameters.watch

    @on(bus_topics.HEARTBEAT)
    def heartbeat(self, message: Heartbeat, header: Header) -> None:
        """Note how late a node was, except before the run begins, while the system starts."""
        now_s, begins_s = self.clock.now(), self.context.run.plan.begins_s
        self._pids[header.source] = self.context.local_pid(header.source, message.pid)
        late_s = max(message.late_s, self.came_s(header) - header.stamp)
        if late_s > self._too_late_s and header.stamp > begins_s and not (
                self._absence.excuses(now_s)):
            chosen = self.parameters
            self._late_until_s[header.source] = now_s + max(
                chosen.within_s, min(late_s, chosen.clear_s))
            self._judge()

    @every(_LOOK_S)
    def look(self) -> None:
        """Check whether it is over."""
        self._judge()

    def _judge(self) -> None:
        now_s = self.clock.now()
        late = sum(until_s > now_s for until_s in self._late_until_s.values())
        if late >= self._many:
            self._was_late_s = now_s
        elif now_s < self._knows_from_s:
            return  # a respawned module may have missed the start of the overload
        # The reason stays the same, since each new one is a new report.
        wrong = late >= self._many or (self.monitor.active and self._still_wait(now_s))
        self.monitor.note(
            f"many of {len(self.parameters.watch)} nodes are late at once" if wrong else "", now_s)
        self.follow()

    def _still_wait(self, now_s: float) -> bool:
        passed_s = now_s - self._sampled_s
        if passed_s >= _SAMPLE_S:
            before, self._sampled_s = self._waited_s, now_s
            self._waited_s = {
                pid: self.context.scheduled(pid).waited_s for pid in self._pids.values()}
            long_s = self.parameters.wait_share * passed_s / self.clock.rate
            waiting = sum(pid in before and waited_s - before[pid] >= long_s
                          for pid, waited_s in self._waited_s.items())
            self._may_wait = waiting >= self._many
        return self._may_wait and now_s - self._was_late_s < self.parameters.wait_s
