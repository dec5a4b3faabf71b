"""DM10's monitor: is the route that the Graph Planner gives one that may be driven?

One bad route is enough; it is an error the moment it is published. Good ones have to come for a
while before the monitor is idle again, so that a planner that is wrong now and then does not look
cured each time in between. A planner that was respawned is believed with its first good route.

A planner that was given a wrong goal is not to blame: if the goal is another point than the
mission's status has at that step, it is the one who gave the goal.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from rampart.actors.detection.lasting import Lasting
from rampart.actors.osmosis.messages import GoalOrder, MissionPhase, MissionStatus, Route

RouteFault = Callable[[tuple[tuple[float, float], ...], tuple[float, float] | None], str]
"""Returns what is wrong with waypoints that shall lead to a goal, or ""."""


class RouteMonitor:
    """Active while the routes are bad.

    Args:
        fault: says what is wrong with a route.
        hold_s: how long routes must have been good again, s.
        known_after_s: when idle may be claimed without a route heard; -inf for at once.
    """

    def __init__(self, fault: RouteFault, hold_s: float, known_after_s: float = -math.inf) -> None:
        self._fault = fault
        self._known_after_s = known_after_s
        self._goal: GoalOrder | None = None
        self._giver = ("", 0)
        self._status: MissionStatus | None = None
        self._blamed: tuple[str, int] = ("", 0)
        self._good = Lasting(hold_s)
        self.known = known_after_s == -math.inf
        self.reason = ""

    @property
    def active(self) -> bool:
        """Whether the routes are bad."""
        return bool(self.reason)

    @property
    def nodes(self) -> tuple[str, ...]:
        """Who is to blame: the node and which life of it, for it is alive."""
        return (f"{self._blamed[0]}#{self._blamed[1]}",) if self.active else ()

    @property
    def due_s(self) -> float:
        """Only the wait for a first route ends by itself."""
        return math.inf if self.known else self._known_after_s

    def expire(self, now_s: float) -> None:
        """Give up waiting for a first route: without a mission there is none."""
        self.known = self.known or now_s >= self._known_after_s

    def mission(self, status: MissionStatus) -> None:
        """Take note of the mission's own goals."""
        self._status = status

    def goal(self, order: GoalOrder, source: str, incarnation: int) -> None:
        """Take note of the goal that routes shall lead to, and who gave it."""
        self._goal, self._giver = order, (source, incarnation)

    def route(self, route: Route, source: str, incarnation: int, now_s: float) -> None:
        """Check a route and remember who gave it."""
        self.known = True
        fault = self._fault_of(route)
        cured = self._good.note(not fault, now_s)
        if fault:
            self.reason = self.reason or fault
            self._blamed = self._giver if self._wrong_goal(route) else (source, incarnation)
        elif self.active:
            reborn = any(node == self._blamed[0] and life > self._blamed[1]
                         for node, life in ((source, incarnation), self._giver))
            if reborn or cured:
                self.reason = ""

    def _fault_of(self, route: Route) -> str:
        if not route.active or not route.waypoints:
            return ""
        order = self._goal
        same = order is not None and order.active and (
            (order.mission_id, order.step) == (route.mission_id, route.step))
        return self._fault(
            route.waypoints, (order.goal.x_m, order.goal.y_m) if order and same else None)

    def _wrong_goal(self, route: Route) -> bool:
        """Whether the route is for a goal that the mission does not have."""
        order, status = self._goal, self._status
        if order is None or status is None or status.phase is not MissionPhase.RUNNING \
                or (order.mission_id, order.step) != (route.mission_id, route.step):
            return False
        return order.mission_id != status.mission_id or not (
            order.step < len(status.goals) and status.goals[order.step] == order.goal)
