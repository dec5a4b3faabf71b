"""Graph Planner: plans the route to the current goal over the airport's graph."""

from __future__ import annotations

import math

import msgspec

from rampart.actors.bus.bounds import clip
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.airport.model import Point, show
from rampart.actors.osmosis.application import Osmosis
from rampart.actors.osmosis.control.planning.route_search import (
    Closures,
    PlannedRoute,
    plan_route,
    without,
)
from rampart.actors.osmosis.messages import Blockage, ControlStatus, GoalOrder, Mode, Pose, Route
from rampart.actors.osmosis.readings import is_pose
from rampart.actors.runtime.actor import Actor, Context, Header, every, on
from rampart.actors.runtime.checkpoint import StateFormat
from rampart.manager.spec.tables import NonNegative


class RouteKept(msgspec.Struct, frozen=True):
    """State of the Graph Planner: the goal and its route."""

    order: GoalOrder
    route: Route


def _objection(kept: RouteKept) -> str:
    if not all(math.isfinite(v) for waypoint in kept.route.waypoints for v in waypoint):
        return "a waypoint is not finite"
    order, route = kept.order, kept.route
    same = (order.which, order.active) == (route.which, route.active)
    return "" if same else f"route of step {route.step}, goal of step {order.step}"


ROUTE_STATE = StateFormat(RouteKept, version=1, objection=_objection)


class GraphPlanner(Actor):
    """Plans once per goal, from the latest pose, and repeats the route.

    The route changes only with the goal. A restarted planner restores its route from the checkpoint
    and repeats it when it receives the same goal; without one it plans from the present pose.

    If Osmosis Control reports a blockage, the planner may plan around it: the graph near that place
    is closed for a while. Without another route the present one stays, and the robot waits.
    """

    class Parameters(Actor.Parameters, frozen=True):
        """Reaction to blockages.

        Attributes:
            replan_after_s: duration of a blockage before it plans around it, s; 0: never, as in
                the paper.
            avoid_for_s: duration of a closure, s.
            avoid_gap_m: radius of a closure, m.
        """

        replan_after_s: NonNegative = 0.0
        avoid_for_s: NonNegative = 60.0
        avoid_gap_m: NonNegative = 1.0

    parameters: Parameters
    outputs = (topics.ROUTE,)

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._airport = Osmosis.of(context).airport
        self._pose: Pose | None = None
        self._order: GoalOrder | None = None
        self._route: Route | None = None
        self._closures = Closures(self.parameters.avoid_gap_m, self.parameters.avoid_for_s)
        self._try_again_s = -math.inf
        self._blocked: Blockage | None = None
        self._kept: RouteKept | None = None

    def on_start(self) -> None:
        """Restore the checkpoint; its route may be outdated and waits for its goal."""
        self._kept = self.kept(ROUTE_STATE)

    @on(topics.POSE)
    def pose(self, message: Pose, _header: Header) -> None:
        """Keep the latest valid pose; plan if a goal waits for it."""
        if not is_pose(message):
            return
        self._pose = message
        if self._route is None:
            self._plan()

    @on(topics.GOAL)
    def goal(self, message: GoalOrder, _header: Header) -> None:
        """Plan to a new goal."""
        if message == self._order:
            return
        before, self._order = self._order, message
        if self._blocked is not None and before is not None and message.plan > before.plan \
                and message.which == before.which:
            # Another plan was ordered while a blockage is known.
            self._closures.close((self._blocked.x_m, self._blocked.y_m), self.clock.now())
        self._route = self._blocked = None
        self._try_again_s = -math.inf
        if self._kept is not None and self._kept.order == message:
            self._route = self._kept.route
            self._publish_route()
        else:
            self._plan()
        self._kept = None

    @on(topics.CONTROL_STATUS)
    def control(self, message: ControlStatus, _header: Header) -> None:
        """Plan around a blockage that has lasted long enough."""
        route, now_s = self._route, self.clock.now()
        self._blocked = None
        if route is None or not route.active or message.which != route.which:
            return
        for blockage in message.blocked:
            if not math.isfinite(blockage.x_m + blockage.y_m):
                continue
            self._blocked = blockage
            after_s = self.parameters.replan_after_s
            if 0 < after_s <= now_s - blockage.since_s and now_s >= self._try_again_s:
                self._try_again_s = now_s + after_s
                self._plan_around(blockage, now_s)

    @every(0.2)
    def repeat(self) -> None:
        """Repeat the route."""
        self._publish_route()

    def _publish_route(self) -> None:
        """Save the route, then publish it."""
        if self._order is not None and self._route is not None:
            self.keep(ROUTE_STATE, RouteKept(self._order, self._route))
            self.publish(topics.ROUTE, self._route)

    def _plan(self) -> None:
        order, pose = self._order, self._pose
        if order is None:
            return
        if not order.active:
            self._route = _route(order, (), "")
        elif pose is None:
            return
        else:
            plan = self._search(order, pose)
            if not plan.waypoints and self._closures.closed(self.clock.now()):
                self._closures.reopen()
                plan = self._search(order, pose)
            if plan.reason:
                self.report_diagnostic("route search", plan.reason, order.mission_id)
            self._route = _route(order, plan.waypoints, plan.reason)
        self._publish_route()

    def _plan_around(self, blockage: Blockage, now_s: float) -> None:
        order, pose, place = self._order, self._pose, (blockage.x_m, blockage.y_m)
        if order is None or pose is None:
            return
        self._closures.close(place, now_s)
        plan = self._search(order, pose)
        where = show(place)
        if not plan.waypoints:
            self._closures.reopen()
            self.report_diagnostic("route search", f"no route around {where}: {plan.reason}",
                                   order.mission_id)
            return
        self._route = _route(order, plan.waypoints, f"route around {where}, which is blocked")
        self._publish_route()

    def _search(self, order: GoalOrder, pose: Pose) -> PlannedRoute:
        nodes, edges = without(self._airport.nodes, self._airport.edges,
                               self._closures.closed(self.clock.now()), self._closures.gap_m)
        return plan_route(nodes, edges, (pose.x_m, pose.y_m), (order.goal.x_m, order.goal.y_m),
                          straight=order.goal.mode is Mode.LIGHT_VERIFICATION)


def _route(order: GoalOrder, waypoints: tuple[Point, ...], reason: str) -> Route:
    return Route(*order.which, order.goal.mode, order.active, waypoints, clip(reason), order.plan)
