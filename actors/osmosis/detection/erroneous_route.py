"""DM10: erroneous graph, seen by the route that comes of it, before the robot has driven it.

The paper's fault tree has the event and no mechanism on it but the last, the prohibited area
itself. This module is independent of what it guards: it does not plan. It checks each route on the
map and the graph that it has loaded for itself, so that a Graph Planner whose graph, search or
message went wrong is found out by the first route.
"""

from __future__ import annotations

from rampart.actors.detection.module import DetectionModule
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.airport.route_check import RouteCheck
from rampart.actors.osmosis.application import Osmosis
from rampart.actors.osmosis.detection.route_monitor import RouteMonitor
from rampart.actors.runtime.actor import Context, Header, on
from rampart.manager.spec.tables import NonNegative

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
        airport = Osmosis.of(context).airport
        check = RouteCheck(airport)
        self.monitor = self.judged_by(RouteMonitor(
            lambda waypoints, goal: check.fault(waypoints, None, goal),
            self.parameters.hold_s,
            self.known_after_s(_FIRST_ROUTE_S)))

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
