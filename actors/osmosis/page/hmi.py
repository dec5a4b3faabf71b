"""The operator's page of Osmosis: sends missions and orders, and shows the airport.

`missions` decides what it sends, also after a restart; `driving` explains the joystick's effect.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.operator.bounds import MAX_NAME
from rampart.actors.operator.hmi import Hmi
from rampart.actors.operator.panels import Panel
from rampart.actors.operator.requests import RefusedError, Request
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.airport.model import Airport, Mission
from rampart.actors.osmosis.application import Osmosis
from rampart.actors.osmosis.page.driving import Driving
from rampart.actors.osmosis.page.map import PageMap, lights_shown, page_map
from rampart.actors.osmosis.page.missions import (
    OSMOSIS_REQUESTS,
    OrderRequest,
    Orders,
    StartRequest,
    Submission,
    all_run,
    first_request,
    system_is_up,
)
from rampart.actors.osmosis.page.state import OsmosisState
from rampart.actors.runtime.actor import Context, Header, on
from rampart.files.plain_text import one_line


class OsmosisHmi(Hmi):
    """The operator's node of Osmosis. It waits for no input."""

    optional_inputs = topics.ROBOT

    outputs = (*Hmi.outputs, topics.MISSION_REQUEST, topics.MISSION_ORDER, topics.ACTUATOR_FAULT)
    requests = OSMOSIS_REQUESTS
    files = Path(__file__).with_name("files")
    panels = (Panel(title="Airport", script="map.js"), Panel(title="Mission", script="mission.js"),
              Panel(title="Safety Pilot", script="pilot.js"),
              Panel(title="Drive", held=f"{topics.JOYSTICK.key}:dead_man", stick=(
                  f"{topics.JOYSTICK.key}:forward", f"{topics.JOYSTICK.key}:left")))
    shown = (*Hmi.shown, topics.POSE, topics.SCAN, topics.UPPER_SCAN, topics.ROUTE,
             topics.CONTROL_STATUS, topics.PILOT_STATUS, topics.OBSTACLES, topics.LIGHT_MEASURED,
             topics.BASE_STATUS)
    drawn = (topics.SCAN, topics.UPPER_SCAN)
    _state: OsmosisState
    _operating: Driving

    def __init__(self, context: Context) -> None:
        run, plan = context.run, context.run.plan
        known = run.application if isinstance(run.application, Osmosis) else None
        self._airport: Airport | None = known.airport if known else None
        super().__init__(context)
        mission: Mission | None = known.mission if known and known.mission.goals else None
        self._missions: Mapping[str, Mission] = (
            {mission.name: mission} if mission and plan.waits
            else self._airport.missions if self._airport else {})
        self._submission = Submission(
            plan.run_id, context.incarnation, self.clock.now(),
            first_request(plan.run_id, mission.name, _goals(mission))
            if mission and not plan.waits else None)
        self._orders = Orders(f"{plan.run_id}/{context.name}.{context.incarnation}", "operator")

    def _make_state(self) -> OsmosisState:
        return OsmosisState(lights_shown(self._airport) if self._airport else None)

    def _make_operating(self) -> Driving:
        return Driving(self, self._state, self._panels)

    def _hello(self) -> dict[str, Any]:
        robot = self.context.run.system.mobile
        return {
            **super()._hello(),
            "map": self._map.encoded if self._map else None,
            "left_out": self._map.left_out if self._map else {},
            "footprint_m": (robot.length_m, robot.width_m) if robot else None,
            "missions": [name for name in self._missions if name == one_line(name, MAX_NAME)][:200],
            "track": list(self._state.track)}

    @cached_property
    def _map(self) -> PageMap | None:
        return page_map(self._airport) if self._airport else None

    # -- missions and orders --------------------------------------------------------------------

    def _repeat(self) -> None:
        now = self.clock.now()
        if outcome := self._submission.expire(now):
            self._state.log(now, "note", outcome)
        self._submit()
        self._show_outcome(self._orders.expire(now))
        if self._orders.pending is not None:
            self.publish(topics.MISSION_ORDER, self._orders.pending)
        super()._repeat()

    @on(ftm_topics.NODES)
    def _nodes(self, message: fm.NodeTable, header: Header) -> None:
        did_all_run = all_run(self._table)
        super()._nodes(message, header)
        if not did_all_run:
            self._submit()

    def _submit(self) -> None:
        """Send the pending mission, if the system is up."""
        if self._submission.pending is not None and system_is_up(
                self._table, self.clock.now() - self.context.run.plan.begins_s):
            self.publish(topics.MISSION_REQUEST, self._submission.pending)

    def _show_outcome(self, outcome: str) -> None:
        """Show the outcome of an order, if there is one."""
        if outcome:
            self._state.announce(outcome, self.clock.now(), "order to the mission: ")

    def _fulfil(self, request: Request, page: int) -> str | dict[str, Any]:
        match request:
            case StartRequest():
                return self._start(request.name)
            case OrderRequest():
                order = self._orders.give(request.action, request.reason, self.clock.now())
                self.publish(topics.MISSION_ORDER, order)
                return f"{request.action.value} requested"
        return super()._fulfil(request, page)

    def _start(self, name: str) -> str:
        if name not in self._missions:
            raise RefusedError(f"unknown mission {name[:40]!r}; known: "
                               f"{', '.join(self._missions) or 'none'}")
        self.publish(topics.MISSION_REQUEST, self._submission.ask(
            name, _goals(self._missions[name]), self.clock.now()))
        return f"mission {name} requested"

    # -- inputs ---------------------------------------------------------------------------------

    @on(topics.MISSION_STATUS)
    def _mission_status(self, message: m.MissionStatus, _header: Header) -> None:
        self._submission.hear(message)
        self._orders.hear(message)
        self._state.mission(message, self.clock.now())

    @on(topics.MISSION_ORDER_ANSWER)
    def _order_answer(self, message: m.MissionOrderAnswer, _header: Header) -> None:
        self._show_outcome(self._orders.answer(message))

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

    @on(topics.OBSTACLES)
    def _obstacles(self, message: m.ObstacleList, _header: Header) -> None:
        self._state.obstacles(message)

    @on(topics.BASE_STATUS)
    def _base(self, message: m.BaseStatus, _header: Header) -> None:
        self._operating.base(message)

    @on(topics.LIGHT_MEASURED)
    def _light(self, message: m.LightMeasurement, _header: Header) -> None:
        self._state.light(message)


def _goals(mission: Mission) -> tuple[m.Goal, ...]:
    return tuple(m.Goal(g.x_m, g.y_m, m.Mode(g.mode)) for g in mission.goals)
