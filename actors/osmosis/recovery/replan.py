"""RM6: replan. The robot keeps driving, or waits, until it has another way to its goal.

Not among the paper's recoveries: it leaves open how the FTM Manager tells the control nodes that a
plan is no good. Here it asks the Mission Manager, who knows whether there is a mission to plan for,
and who orders the Graph Planner; the answer is the route itself.
"""

from __future__ import annotations

from rampart.actors.ftm.messages import RecoveryCommand, RecoveryPhase
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.messages import MissionAction, MissionOrder, MissionOrderAnswer, Route
from rampart.actors.recovery.module import RecoveryModule
from rampart.actors.runtime.actor import Context, Header, on


class Replan(RecoveryModule):
    """Asks for another plan, and is done when the route that comes of it is there.

    It fails if the Mission Manager refuses, if there is no way, or at its deadline.
    """

    outputs = (*RecoveryModule.outputs, topics.MISSION_ORDER)

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._order: MissionOrder | None = None
        self._plan: int | None = None

    def act(self, command: RecoveryCommand, *, renewed: bool) -> None:
        """Ask, once for each order."""
        if self._order is not None and not renewed:
            return
        self._order = MissionOrder(f"{self.name}-{self.context.incarnation}-{command.decision}",
                                   MissionAction.REPLAN, command.reason, self.name)
        self._plan = None
        self.resume(command.reason)
        self.publish(topics.MISSION_ORDER, self._order)

    def let_go(self) -> None:
        """Forget the order: the robot has its route."""
        self._order = self._plan = None

    def repeat(self) -> None:
        """Repeat what the Mission Manager has not answered; it takes it for one order."""
        if self._order is not None and self._plan is None and self.phase is RecoveryPhase.ACTING:
            self.publish(topics.MISSION_ORDER, self._order)

    def unfinished(self) -> str:
        """Say what is missing."""
        return "no answer from the Mission Manager" if self._plan is None else "no new route"

    @on(topics.MISSION_ORDER_ANSWER)
    def answer(self, message: MissionOrderAnswer, _header: Header) -> None:
        """Hear whether the order is obeyed."""
        if self._order is None or message.order != self._order.order or self._plan is not None:
            return
        if message.accepted:
            self._plan = message.plan
        else:
            self.fail(f"refused: {message.reason}")

    @on(topics.ROUTE)
    def route(self, message: Route, _header: Header) -> None:
        """See the new route come."""
        if self._plan is None or not message.active or message.plan < self._plan \
                or self.phase is not RecoveryPhase.ACTING:
            return
        if message.waypoints:
            self.succeed(message.reason or "planned anew")
        else:
            self.fail(f"no way: {message.reason}")
