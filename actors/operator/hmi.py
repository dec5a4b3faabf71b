"""The HMI: hands missions, orders and resets to the controller, and shows what happens.

A non-control node (paper, section III): memoryless, may be killed and respawned at any time. What
it must not do after a respawn is decided in `hmi_submission`, which orders make sense in
`hmi_orders`; what it shows is collected in `hmi_state`; the page is served by `hmi_server`.
"""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from typing import Any

from actors import messages as m
from actors import topics
from actors.operator.hmi_orders import NoSenseError, Orders
from actors.operator.hmi_server import (
    MissionWish,
    OrderWish,
    PageServer,
    PortError,
    RefusedError,
    Wish,
)
from actors.operator.hmi_state import HmiState
from actors.operator.hmi_submission import (
    REPEAT_S,
    BusyError,
    Submission,
    first_request,
    system_is_up,
)
from actors.runtime.actor import Actor, Context, Header, every, on
from actors.runtime.topic import Topic
from airport.drawing import draw
from airport.model import Airport, Mission

__all__ = ["Hmi"]


class Hmi(Actor):
    """The operator's node.

    Shared objects: "run_id" (text, required for a mission), "mission" (the mission the run starts
    with, or None), "airport" (for the map and its missions), "hmi_port" (0 or None: no page; the
    parameter `port` has precedence).
    """

    outputs = (topics.MISSION_REQUEST, topics.MISSION_ORDER, topics.RESET)

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        shared = context.shared
        self._airport: Airport | None = shared.get("airport")
        mission: Mission | None = shared.get("mission")
        run_id = str(shared.get("run_id", "run"))
        first = first_request(run_id, mission.name, _goals(mission)) if mission else None
        self._submission = Submission(run_id, context.incarnation, self.clock.now(), first)
        self._orders = Orders(f"{run_id}/{context.name}.{context.incarnation}", "operator")
        self._state = HmiState()
        self._table: m.NodeTable | None = None
        self._port: int = self.parameters.get("port", shared.get("hmi_port")) or 0
        self._server: PageServer | None = None
        self._starting: asyncio.Task[None] | None = None

    def listens(self, topic: Topic[Any]) -> bool:
        """Without a page, hear only what missions and orders depend on."""
        return bool(self._port) or topic not in _SHOWN

    @property
    def page_port(self) -> int | None:
        """Port on which the page is served, or None."""
        return self._server.port if self._server else None

    def on_start(self) -> None:
        """Send the mission, and open the page's port; the robot drives without the page."""
        self._submit()
        if not self._port:
            return
        try:
            self._server = PageServer(
                self._port, self._hello, lambda: self._state.snapshot(self.clock.now()),
                self._fulfil)
        except PortError as error:
            self.report_diagnostic("operator's page", str(error), f"port {self._port}")
            return
        self._starting = asyncio.get_running_loop().create_task(self._server.start())
        self._starting.add_done_callback(self._page_started)

    def on_stop(self) -> None:
        """Close the page."""
        if self._starting is not None:
            self._starting.cancel()
        if self._server is not None:
            self._server.stop()

    def _page_started(self, task: asyncio.Task[None]) -> None:
        if not task.cancelled() and (error := task.exception()) is not None:
            self._server = None
            self.report_diagnostic("operator's page", f"{type(error).__name__}: {error}",
                                   f"port {self._port}")

    # -- missions, orders and resets ------------------------------------------------------------

    @every(REPEAT_S)
    def _submit(self) -> None:
        now = self.clock.now()
        withdrawn = self._submission.expire(now)
        if withdrawn is not None:
            self._state.log(now, "note", f"mission {withdrawn.name} was not taken: "
                                         "the Mission Manager does not answer")
        if self._submission.pending is not None and system_is_up(self._table, now):
            self.publish(topics.MISSION_REQUEST, self._submission.pending)
        self._tell(self._orders.expire(now))
        if self._orders.pending is not None:
            self.publish(topics.MISSION_ORDER, self._orders.pending)

    def _tell(self, outcome: str) -> None:
        """Say what became of an order, if there is anything to say."""
        if outcome:
            self._state.order(outcome, self.clock.now())

    def _fulfil(self, wish: Wish) -> str:
        if isinstance(wish, MissionWish):
            return self._start(wish.name)
        if isinstance(wish, OrderWish):
            return self._order(wish)
        if wish.recovery not in self._state.latched:
            waiting = ", ".join(self._state.latched) or "none"
            raise RefusedError(f"{wish.recovery[:40]!r} does not wait for a reset; "
                               f"waiting: {waiting}")
        self.publish(topics.RESET, m.Reset(wish.recovery, self.name))
        return f"reset of {wish.recovery} asked for"

    def _start(self, name: str) -> str:
        missions: Mapping[str, Mission] = self._airport.missions if self._airport else {}
        if name not in missions:
            raise RefusedError(f"no mission {name[:40]!r}; there are: "
                               f"{', '.join(missions) or 'none'}")
        try:
            request = self._submission.ask(name, _goals(missions[name]), self.clock.now())
        except BusyError as error:
            raise RefusedError(str(error)) from None
        self.publish(topics.MISSION_REQUEST, request)
        return f"mission {name} asked for"

    def _order(self, wish: OrderWish) -> str:
        try:
            order = self._orders.give(wish.action, wish.reason, self.clock.now())
        except NoSenseError as error:
            raise RefusedError(str(error)) from None
        self.publish(topics.MISSION_ORDER, order)
        return f"{wish.action.value} asked for"

    def _hello(self) -> dict[str, Any]:
        airport = self._airport
        return {
            "type": "hello",
            "run_id": str(self.context.shared.get("run_id", "run")),
            "rate": self.clock.rate,
            "map": draw(airport) if airport else None,
            "missions": list(airport.missions) if airport else [],
            "track": list(self._state.track),
        }

    # -- hearing --------------------------------------------------------------------------------

    @on(topics.MISSION_STATUS)
    def _mission_status(self, message: m.MissionStatus, _header: Header) -> None:
        self._submission.hear(message)
        self._orders.hear(message)
        self._state.mission(message, self.clock.now())

    @on(topics.MISSION_ORDER_ANSWER)
    def _order_answer(self, message: m.MissionOrderAnswer, _header: Header) -> None:
        self._tell(self._orders.answer(message))

    @on(topics.POSE)
    def _pose(self, message: m.Pose, header: Header) -> None:
        self._state.pose(message, header.stamp)

    @on(topics.ROUTE)
    def _route(self, message: m.Route, _header: Header) -> None:
        self._state.keep("route", message, self.clock.now())

    @on(topics.CONTROL_STATUS)
    def _control(self, message: m.ControlStatus, _header: Header) -> None:
        self._state.keep("control", message, self.clock.now())

    @on(topics.PILOT_STATUS)
    def _pilot(self, message: m.PilotStatus, _header: Header) -> None:
        self._state.keep("pilot", message, self.clock.now())

    @on(topics.MANAGER_STATUS)
    def _manager(self, message: m.ManagerStatus, _header: Header) -> None:
        self._state.manager(message, self.clock.now())

    @on(topics.NODES)
    def _nodes(self, message: m.NodeTable, _header: Header) -> None:
        self._table = message
        self._state.keep("nodes", message, self.clock.now())

    @on(topics.OBSTACLES)
    def _obstacles(self, message: m.ObstacleList, _header: Header) -> None:
        self._state.keep("obstacles", message, self.clock.now())

    @on(topics.DECISION)
    def _decision(self, message: m.DecisionRecord, header: Header) -> None:
        self._state.decision(message, header.stamp)

    @on(topics.PROCESS_EVENT)
    def _process_event(self, message: m.ProcessEvent, header: Header) -> None:
        self._state.process_event(message, header.stamp)

    @on(topics.ERROR_REPORT)
    def _diagnostic(self, message: m.Diagnostic, header: Header) -> None:
        self._state.diagnostic(message, header.stamp)

    @on(topics.LIGHT_MEASURED)
    def _light(self, message: m.LightMeasurement, _header: Header) -> None:
        self._state.light(message)


_SHOWN = (
    topics.POSE, topics.ROUTE, topics.CONTROL_STATUS, topics.PILOT_STATUS, topics.OBSTACLES,
    topics.PROCESS_EVENT, topics.ERROR_REPORT, topics.LIGHT_MEASURED)
"""What is heard for the page alone."""


def _goals(mission: Mission) -> tuple[m.Goal, ...]:
    return tuple(m.Goal(g.x_m, g.y_m, m.Mode(g.mode)) for g in mission.goals)
