"""DM10: erroneous graph, seen by the route that comes of it, before the robot has driven it.

The paper's fault tree has the event and no mechanism on it but the last, the prohibited area
itself. This module is independent of what it guards: it does not plan. It checks each route on the
map and the graph that it has loaded for itself, so that a Graph Planner whose graph, search or
message went wrong is found out by the first route.

One bad route is enough; it is an error the moment it is published. Good ones have to come for a
while before the monitor is idle again, so that a planner that is wrong now and then does not look
cured each time in between. A planner that was respawned is believed with its first good route.

A planner that was given a wrong goal is not to blame: if the goal is another point than the
mission's status has at that step, it is the one who gave the goal.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from rampart.actors.detection.finding import Finding, Lasting
from rampart.actors.detection.module import DetectionModule
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.airport.route_check import RouteCheck
from rampart.actors.osmosis.application import Osmosis
from rampart.actors.runtime.actor import Context, Header, on
from rampart.manager.spec.tables import NonNegative

RouteFault = Callable[[tuple[tuple[float, float], ...], tuple[float, float] | None], str]
"""Returns what is wrong with waypoints that shall lead to a goal, or ""."""


class RouteMonitor(Finding):
    """Active while the routes are bad.

    Args:
        fault: says what is wrong with a route.
        hold_s: how long routes must have been good again, s.
        known_after_s: when idle may be claimed without a route heard; -inf for at once.
    """

    def __init__(self, fault: RouteFault, hold_s: float, known_after_s: float = -math.inf) -> None:
        super().__init__(known_after_s)
        self._fault = fault
        self._goal: m.GoalOrder | None = None
        self._giver = ("", 0)
        self._status: m.MissionStatus | None = None
        self._blamed: tuple[str, int] = ("", 0)
        self._good = Lasting(hold_s)

    def mission(self, status: m.MissionStatus) -> None:
        """Take note of the mission's own goals."""
        self._status = status

    def goal(self, order: m.GoalOrder, source: str, incarnation: int) -> None:
        """Take note of the goal that routes shall lead to, and who gave it."""
        self._goal, self._giver = order, (source, incarnation)

    def route(self, route: m.Route, source: str, incarnation: int, now_s: float) -> None:
        """Check a route and remember who gave it."""
        self.known = True
        fault = self._fault_of(route)
        cured = self._good.note(not fault, now_s)
        if fault:
            self.reason = self.reason or fault
            self._blamed = self._giver if self._wrong_goal(route) else (source, incarnation)
            self.nodes = (f"{self._blamed[0]}#{self._blamed[1]}",)
        elif self.active:
            reborn = any(node == self._blamed[0] and life > self._blamed[1]
                         for node, life in ((source, incarnation), self._giver))
            if reborn or cured:
                self.clear()

    def _fault_of(self, route: m.Route) -> str:
        if not route.active or not route.waypoints:
            return ""
        order = self._goal
        same = order is not None and order.active and (
            (order.mission_id, order.step) == (route.mission_id, route.step))
        return self._fault(
            route.waypoints, (order.goal.x_m, order.goal.y_m) if order and same else None)

    def _wrong_goal(self, route: m.Route) -> bool:
        """Whether the route is for a goal that the mission does not have."""
        order, status = self._goal, self._status
        if order is None or status is None or status.phase is not m.MissionPhase.RUNNING \
                or (order.mission_id, order.step) != (route.mission_id, route.step):
            return False
        return order.mission_id != status.mission_id or not (
            order.step < len(status.goals) and status.goals[order.step] == order.goal)


_FIRST_ROUTE_S = 0.5
"""A respawned module waits this long for a first route, two periods, before it says idle."""


class ErroneousRoute(DetectionModule):
    """Active while the Graph Planner gives routes that must not be driven; names it as failed."""

    class Parameters(DetectionModule.Parameters, frozen=True):
        """Patience.

        Attributes:
            hold_s: how long routes must have been good again before the module is idle, s.
        """

        hold_s: NonNegative = 0.5

    parameters: Parameters

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        check = RouteCheck(Osmosis.of(context).airport)
        self.monitor = self.judged_by(RouteMonitor(
            lambda waypoints, goal: check.fault(waypoints, None, goal),
            self.parameters.hold_s, self.known_after_s(_FIRST_ROUTE_S)))

    @on(topics.MISSION_STATUS)
    def mission(self, message: m.MissionStatus, _header: Header) -> None:
        """Keep the mission's goals."""
        self.monitor.mission(message)

    @on(topics.GOAL)
    def goal(self, message: m.GoalOrder, header: Header) -> None:
        """Keep the goal."""
        self.monitor.goal(message, header.source, header.incarnation)

    @on(topics.ROUTE)
    def route(self, message: m.Route, header: Header) -> None:
        """Check a route."""
        self.monitor.route(message, header.source, header.incarnation, self.clock.now())
        self.follow()
