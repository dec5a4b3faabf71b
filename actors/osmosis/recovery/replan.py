"""RM6: replan. The robot keeps driving, or waits, until it has another route to its goal.

It is not among the paper's recoveries: the paper leaves open how the FTM Manager reports a bad plan
to the control nodes. Here it sends an order to the Mission Manager, which orders the Graph Planner;
the answer is the route itself.
"""

from __future__ import annotations

from rampart.actors.ftm.messages import RecoveryCommand, RecoveryPhase
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.messages import MissionAction, MissionOrder, MissionOrderAnswer, Route
from rampart.actors.recovery.module import RecoveryModule
from rampart.actors.runtime.actor import Context, Header, on


class Replan(RecoveryModule):
    """Orders another plan, and is done when its route is published.

    It fails if the Mission Manager refuses, if there is no route, or at its deadline.
    """

    outputs = (*RecoveryModule.outputs, topics.MISSION_ORDER)

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._order: MissionOrder | None = None
        self._plan: int | None = None

    def act(self, command: RecoveryCommand, *, renewed: bool) -> None:
        """Send one order per command."""
        if self._order is not None and not renewed:
            return
        self._order = MissionOrder(f"{self.name}-{self.context.incarnation}-{command.decision}",
                                   MissionAction.REPLAN, command.reason, self.name)
        self._plan = None
        self.resume(command.reason)
        self.publish(topics.MISSION_ORDER, self._order)

    def let_go(self) -> None:
        """Drop the order."""
        self._order = self._plan = None

    def repeat(self) -> None:
        """Repeat an unanswered order, which counts once by its id."""
        if self._order is not None and self._plan is None and self.phase is RecoveryPhase.ACTING:
            self.publish(topics.MISSION_ORDER, self._order)

    def unfinished(self) -> str:
        """Return what is missing."""
        return "no answer from the Mission Manager" if self._plan is None else "no new route"

    @on(topics.MISSION_ORDER_ANSWER)
    def answer(self, message: MissionOrderAnswer, _header: Header) -> None:
        """Take the answer."""
        if self._order is None or message.order != self._order.order or self._plan is not None:
            return
        if message.accepted:
            self._plan = message.plan
        else:
            self.fail(f"refused: {message.reason}")

    @on(topics.ROUTE)
    def route(self, message: Route, _header: Header) -> None:
        """Take the new route."""
        if self._plan is None or not message.active or message.plan < self._plan \
                or self.phase is not RecoveryPhase.ACTING:
            return
        if message.waypoints:
            self.succeed(message.reason or "replanned")
        else:
            self.fail(f"no route: {message.reason}")
