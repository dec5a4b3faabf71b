"""DM10: erroneous graph, detected by its routes before the robot drives them.

The paper's fault tree has this event without a mechanism but DM1. This module does not plan: it
checks each route on its own copy of the map and the graph. So the first route shows an error in the
graph, the search or the message of the Graph Planner.

A single wrong route is an error. Valid routes have to come for a while before the module is idle
again, so that an intermittent planner does not count as cured. A restarted planner is trusted with
its first valid route.

If the goal of the route is not the mission's at that step, the module names the node that
published the goal instead of the planner.
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

RouteFault = Callable[[tuple[tuple[float, float], ...], tuple[float, float] | None], str]
"""Returns the fault of waypoints to a goal, or ""."""


class RouteMonitor(Finding):
    """Active while routes are wrong.

    Args:
        fault: check of a route.
        hold_s: time that routes must have been valid again, s.
        known_after_s: time from which it may be idle without a route; -inf for at once.
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
        """Take the mission's goals."""
        self._status = status

    def goal(self, order: m.GoalOrder, source: str, incarnation: int) -> None:
        """Take the goal of the routes and its sender."""
        self._goal, self._giver = order, (source, incarnation)

    def route(self, route: m.Route, source: str, incarnation: int, now_s: float) -> None:
        """Check a route and store its sender."""
        self.known = True
        fault = self._fault_of(route)
        cured = self._good.note(not fault, now_s)
        if fault:
            self.reason = self.reason or fault
            self._blamed = self._giver if self._wrong_goal(route) else (source, incarnation)
            self.nodes = (f"{self._blamed[0]}#{self._blamed[1]}",)
        elif self.active:
            restarted = any(node == self._blamed[0] and number > self._blamed[1]
                            for node, number in ((source, incarnation), self._giver))
            if restarted or cured:
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
"""Time that a restarted module waits for a route, two periods, before it reports idle."""

_HOLD_S = 0.5
"""Time that routes must have been valid again before the module is idle."""


class ErroneousRoute(DetectionModule):
    """Active while routes must not be driven; names the Graph Planner or the sender of the goal."""

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        check = RouteCheck(Osmosis.of(context).airport)
        self.monitor = self.judged_by(RouteMonitor(
            lambda waypoints, goal: check.fault(waypoints, None, goal),
            _HOLD_S, self.known_after_s(_FIRST_ROUTE_S)))

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
