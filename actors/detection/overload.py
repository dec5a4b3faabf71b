"""`Overload`: the machine has no processor time left for the system, one cause of many symptoms.

Each heartbeat carries how late the loop of its node was, and its stamp shows how long it was under
way: the bus needs processor time as well. One node that is late may have a fault of its own; where
many are late at once it is what they have in common: the machine. The kernel's figure for that
(`/proc/pressure/cpu`) shows as well that programs wait for a processor, but not which: it is high
whenever anything else uses the machine, also when that takes nothing from the robot.

An overload comes in waves. So it is not over while the nodes still wait for a processor, as the
kernel counts for each (`/proc/PID/schedstat`), unless none was late for a good while.

This module is as short of processor time as those that it watches. Its input is late, but the
same; and if its own reports are missing for too long, the manager takes it for active.
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
"""So many have to be late, or it may be a fault of one."""

_LOOK_S = 0.1
_SAMPLE_S = 0.5

Share = Annotated[float, msgspec.Meta(gt=0, le=1)]


class Overload(DetectionModule):
    """Active while many of the watched nodes are late at once."""

    class Parameters(DetectionModule.Parameters, frozen=True, kw_only=True):
        """Whom it watches, and what is many and late.

        Attributes:
            watch: names of the nodes.
            share: of them, that have to be late; two at least.
            late_s: how late, s; by default half the shortest slack of a timeout of the system.
            within_s: late within so long is late at once, s. One that was later, and may be again
                as long, counts for as long, though not longer than `clear_s`.
            clear_s: how long fewer have to be late before the module is idle again, s ...
            wait_share: ... and as many no longer wait for a processor for so much of the time ...
            wait_s: ... unless they were not late for so long, s.
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
        told = self.parameters
        self._too_late_s = told.late_s or allowed_late_s(context.run.system.timing)
        self._many = max(LEAST, told.share * len(told.watch))
        self._late_until_s: dict[str, float] = {}
        self._pids: dict[str, int] = {}
        self._waited_s: dict[int, float] = {}
        self._sampled_s = self._was_late_s = -math.inf
        self._may_wait = False
        self._knows_from_s = self.known_after_s(told.clear_s)
        self.monitor = self.judged_by(Sustained(0.0, told.clear_s, self._knows_from_s))

    @classmethod
    def names(cls, topic: Topic[Any], name: str, parameters: Parameters) -> Members:  # noqa: ARG003
        """Subscribe to the heartbeats of the watched nodes."""
        return parameters.watch

    @on(bus_topics.HEARTBEAT)
    def heartbeat(self, message: Heartbeat, header: Header) -> None:
        """Note how late a node was; before the run begins the system is starting."""
        now_s, begins_s = self.clock.now(), self.context.run.plan.begins_s
        self._pids[header.source] = self.context.local_pid(header.source, message.pid)
        late_s = max(message.late_s, self.came_s(header) - header.stamp)
        if late_s > self._too_late_s and header.stamp > begins_s and not (
                self._absence.excuses(now_s)):
            told = self.parameters
            self._late_until_s[header.source] = now_s + max(
                told.within_s, min(late_s, told.clear_s))
            self._judge()

    @every(_LOOK_S)
    def look(self) -> None:
        """See whether it is over."""
        self._judge()

    def _judge(self) -> None:
        now_s = self.clock.now()
        late = sum(until_s > now_s for until_s in self._late_until_s.values())
        if late >= self._many:
            self._was_late_s = now_s
        elif now_s < self._knows_from_s:
            return  # a successor: the one before it may have known better
        # The reason stays the same while it lasts: a new one would be a new report each time.
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
