"""Graph Planner: the way to the current goal over the airport's graph."""

from __future__ import annotations

from actors import topics
from actors.control.route_search import plan_route
from actors.messages import GoalOrder, Mode, Pose, Route
from actors.runtime.actor import Actor, Context, Header, every, on
from airport.model import Airport


class GraphPlanner(Actor):
    """Plans once per goal, from the latest pose, and repeats the route.

    While the goal stays the same the route does, so nothing changes under the driving robot. A
    respawned planner plans again from where the robot is then.
    """

    outputs = (topics.ROUTE,)

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._airport: Airport = context.shared["airport"]
        self._pose: Pose | None = None
        self._order: GoalOrder | None = None
        self._route: Route | None = None

    @on(topics.POSE)
    def pose(self, message: Pose, _header: Header) -> None:
        """Keep the latest pose; plan if a goal was waiting for it."""
        self._pose = message
        if self._route is None:
            self._plan()

    @on(topics.GOAL)
    def goal(self, message: GoalOrder, _header: Header) -> None:
        """Plan if the goal is another one."""
        if message != self._order:
            self._order = message
            self._route = None
            self._plan()

    @every(0.2)
    def repeat(self) -> None:
        """Repeat the route for whoever joined late."""
        if self._route is not None:
            self.publish(topics.ROUTE, self._route)

    def _plan(self) -> None:
        order, pose = self._order, self._pose
        if order is None:
            return
        if not order.active:
            self._route = Route(order.mission_id, order.step, order.goal.mode, False, (), "")
        elif pose is None:
            return
        else:
            plan = plan_route(
                self._airport.nodes,
                self._airport.edges,
                (pose.x_m, pose.y_m),
                (order.goal.x_m, order.goal.y_m),
                straight=order.goal.mode is Mode.LIGHT_VERIFICATION,
            )
            if plan.reason:
                self.report_diagnostic("route search", plan.reason, order.mission_id)
            self._route = Route(
                order.mission_id, order.step, order.goal.mode, True, plan.waypoints, plan.reason
            )
        self.publish(topics.ROUTE, self._route)
