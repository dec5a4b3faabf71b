"""The HMI: hands missions, orders and resets to the controller, and shows what happens.

A non-control node (paper, section III): memoryless, may be killed and respawned at any time. What
it must not do after a respawn is decided in `hmi_submission`, which orders make sense in
`hmi_orders`; what it shows is collected in `hmi_state`; the page is served by `hmi_server`.
"""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from functools import cached_property
from typing import Any

import msgspec

from rampart.actors.bus import messages as bm
from rampart.actors.bus import topics as bus_topics
from rampart.actors.bus.envelope import UNREADABLE
from rampart.actors.bus.topic import Topic
from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.operator.bounds import MAX_NAME, clip
from rampart.actors.operator.camera_eye import CameraEye, renderer
from rampart.actors.operator.feed import Feed
from rampart.actors.operator.operating import OUTPUTS, SHOWN, Operating
from rampart.actors.operator.processes import ProcessObserver
from rampart.actors.operator.requests import (
    MissionWish,
    OrderWish,
    RefusedError,
    ResetWish,
    Wish,
)
from rampart.actors.operator.server import Handlers, PageServer, PortError, Visitor
from rampart.actors.operator.state import HmiState
from rampart.actors.operator.system import draw_system
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.airport.model import Airport, Mission
from rampart.actors.osmosis.application import Osmosis
from rampart.actors.osmosis.page.map import PageMap, lights_shown, page_map
from rampart.actors.osmosis.page.orders import NoSenseError, Orders
from rampart.actors.osmosis.page.submission import (
    REPEAT_S,
    BusyError,
    Submission,
    first_request,
    system_is_up,
)
from rampart.actors.run.run_context import NO_SYSTEM
from rampart.actors.runtime.actor import Actor, Context, Header, every, on
from rampart.manager.spec.specification import SystemSpec, check_document

__all__ = ["Hmi"]


class Hmi(Actor):
    """The operator's node."""

    class Parameters(Actor.Parameters, frozen=True):
        """What it serves.

        Attributes:
            camera: module that renders the picture of the robot (`rampart.sim.osmosis.camera`);
                "" for none.
        """

        camera: str = ""

    parameters: Parameters
    outputs = (topics.MISSION_REQUEST, topics.MISSION_ORDER, ftm_topics.RESET, *OUTPUTS)

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        run, plan = context.run, context.run.plan
        known = run.application if isinstance(run.application, Osmosis) else None
        self._airport: Airport | None = known.airport if known else None
        self._port: int = plan.hmi_port
        mission: Mission | None = known.mission if known else None
        run_id, waits = plan.run_id, plan.waits
        first = (first_request(run_id, mission.name, _goals(mission))
                 if mission and mission.goals and not waits else None)
        self._missions: Mapping[str, Mission] = (
            {mission.name: mission} if mission and mission.goals and waits
            else self._airport.missions if self._airport else {})
        self._submission = Submission(run_id, context.incarnation, self.clock.now(), first)
        self._orders = Orders(f"{run_id}/{context.name}.{context.incarnation}", "operator")
        self._state = HmiState(lights_shown(self._airport) if self._airport else None)
        self._operating = Operating(self, self._state)
        self._table: fm.NodeTable | None = None
        self._server: PageServer | None = None
        self._starting: asyncio.Task[None] | None = None
        self._camera = self._make_camera()
        self._observer = ProcessObserver(
            plan.base_port, plan.launcher_pid)
        self._version = -1
        self._show_system(run.system, run.adapted.version if run.adapted else 0)

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
        self._operating.start()
        plan = self.context.run.plan
        try:
            self._server = PageServer(
                self._port, Feed(self._state, self.clock.now, self._hello, self._look),
                Handlers(lambda page: self._operating.introduction(page.number), self._fulfil,
                         lambda page: self._operating.left(page.number)),
                plan.hmi_host, plan.hmi_token,
                camera=self._camera)
        except PortError as error:
            self.report_diagnostic("operator's page", str(error), f"port {self._port}")
            return
        self._starting = asyncio.get_running_loop().create_task(self._server.start())
        self._starting.add_done_callback(self._page_started)

    def on_stop(self) -> None:
        """Close the page."""
        self._operating.stop()
        if self._camera is not None:
            self._camera.close()
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
        self._operating.repeat()

    def _tell(self, outcome: str) -> None:
        """Say what became of an order, if there is anything to say."""
        if outcome:
            self._state.order(outcome, self.clock.now())

    def _fulfil(self, wish: Wish, visitor: Visitor) -> str | dict[str, Any]:
        match wish:
            case MissionWish():
                return self._start(wish.name)
            case OrderWish():
                return self._order(wish)
            case ResetWish():
                return self._reset(wish)
            case _:
                return self._operating.fulfil(wish, visitor.number)

    def _reset(self, wish: ResetWish) -> str:
        if wish.recovery not in self._state.latched:
            waiting = ", ".join(self._state.latched) or "none"
            raise RefusedError(f"{wish.recovery[:40]!r} does not wait for a reset; "
                               f"waiting: {waiting}")
        self.publish(ftm_topics.RESET, fm.Reset(wish.recovery, self.name))
        return f"reset of {wish.recovery} asked for"

    def _start(self, name: str) -> str:
        if name not in self._missions:
            raise RefusedError(f"no mission {name[:40]!r}; there are: "
                               f"{', '.join(self._missions) or 'none'}")
        try:
            request = self._submission.ask(name, _goals(self._missions[name]), self.clock.now())
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
        return {
            "type": "hello",
            "run_id": self.context.run.plan.run_id,
            "rate": self.clock.rate,
            "map": self._map.encoded if self._map else None,
            "left_out": self._map.left_out if self._map else {},
            "footprint_m": self._footprint_m,
            "camera": self._camera is not None,
            "missions": [name for name in self._missions if name == clip(name, MAX_NAME)][:200],
            "track": list(self._state.track),
        }

    def _make_camera(self) -> CameraEye | None:
        module = self.parameters.camera
        if not (module and self._port and self._airport and self._airport.source):
            return None
        return CameraEye(renderer(module), {"airport": self._airport.source}, self._camera_view)

    def _camera_view(self) -> dict[str, Any] | None:
        heard = self._state.picture.value("pose")
        if heard is None:
            return None
        return {**msgspec.structs.asdict(heard.value), "obstacles": [
            (o.name, o.x_m, o.y_m, o.radius_m) for o in self._state.picture.value("obstacles")]}

    @property
    def _footprint_m(self) -> tuple[float, float] | None:
        robot = self.context.run.system.mobile
        return (robot.length_m, robot.width_m) if robot else None

    @cached_property
    def _map(self) -> PageMap | None:
        return page_map(self._airport) if self._airport else None

    def _look(self) -> None:
        self._state.usage(self._observer.look(self._table))

    def _show_system(self, system: SystemSpec, version: int) -> None:
        if self._port and system is not NO_SYSTEM and version > self._version:
            self._version = version
            self._state.system(draw_system(system))

    # -- hearing --------------------------------------------------------------------------------

    @on(ftm_topics.ADAPTED_SYSTEM)
    def _adapted(self, message: fm.AdaptedSystem, _header: Header) -> None:
        if message.version <= self._version:
            return
        try:
            document = msgspec.json.decode(message.document, type=dict[str, Any])
            system = check_document(document, "changed system")
        except UNREADABLE as error:
            self.report_diagnostic("changed system", clip(f"not shown: {error}"), self.name)
            return
        self._show_system(system, message.version)

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
        self._state.pose(message, header.stamp, self.clock.now())

    @on(topics.SCAN)
    def _scan(self, message: m.LaserScan, _header: Header) -> None:
        self._state.laser("laser", message, self.clock.now())

    @on(topics.UPPER_SCAN)
    def _upper_scan(self, message: m.LaserScan, _header: Header) -> None:
        self._state.laser("upper_laser", message, self.clock.now())

    @on(topics.ROUTE)
    def _route(self, message: m.Route, _header: Header) -> None:
        self._state.route(message)

    @on(topics.CONTROL_STATUS)
    def _control(self, message: m.ControlStatus, _header: Header) -> None:
        self._state.keep("control", message, self.clock.now())

    @on(topics.PILOT_STATUS)
    def _pilot(self, message: m.PilotStatus, _header: Header) -> None:
        self._operating.pilot(message)
        self._state.keep("pilot", message, self.clock.now())

    @on(ftm_topics.MANAGER_STATUS)
    def _manager(self, message: fm.ManagerStatus, _header: Header) -> None:
        self._operating.manager(message)
        self._state.manager(message, self.clock.now())

    @on(ftm_topics.NODES)
    def _nodes(self, message: fm.NodeTable, _header: Header) -> None:
        self._operating.nodes(message)
        self._table = message
        self._state.keep("nodes", message, self.clock.now())

    @on(topics.OBSTACLES)
    def _obstacles(self, message: m.ObstacleList, _header: Header) -> None:
        self._state.obstacles(message)

    @on(ftm_topics.DECISION)
    def _decision(self, message: fm.DecisionRecord, header: Header) -> None:
        self._state.decision(message, header.stamp)

    @on(ftm_topics.PROCESS_EVENT)
    def _process_event(self, message: fm.ProcessEvent, header: Header) -> None:
        self._state.process_event(message, header.stamp)

    @on(ftm_topics.ERROR_REPORT)
    def _diagnostic(self, message: bm.Diagnostic, header: Header) -> None:
        self._state.diagnostic(message, header.stamp)
        self._operating.diagnostic(message)

    @on(ftm_topics.ADAPTATION)
    def _adaptation(self, message: fm.AdaptationAnswer, _header: Header) -> None:
        self._operating.answered(message)

    @on(bus_topics.INJECTION_RESULT)
    def _injection(self, message: bm.InjectionReport, _header: Header) -> None:
        self._operating.injected(message)

    @on(topics.BASE_STATUS)
    def _base(self, message: m.BaseStatus, _header: Header) -> None:
        self._operating.base(message)

    @on(topics.LIGHT_MEASURED)
    def _light(self, message: m.LightMeasurement, _header: Header) -> None:
        self._state.light(message)


_SHOWN = (
    topics.POSE, topics.SCAN, topics.UPPER_SCAN, topics.ROUTE, topics.CONTROL_STATUS,
    topics.PILOT_STATUS, topics.OBSTACLES, ftm_topics.ADAPTED_SYSTEM,
    ftm_topics.PROCESS_EVENT, ftm_topics.ERROR_REPORT, topics.LIGHT_MEASURED, *SHOWN)
"""What is heard for the page alone."""


def _goals(mission: Mission) -> tuple[m.Goal, ...]:
    return tuple(m.Goal(g.x_m, g.y_m, m.Mode(g.mode)) for g in mission.goals)
