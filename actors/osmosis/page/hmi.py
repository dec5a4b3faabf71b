"""The operator's page of Osmosis: sends missions and orders, and shows the airport.

**Missions.** A request is repeated until the Mission Manager shows the mission, since it may start
later or be restarting. It is never sent again afterwards. In the paper a Mission Manager that
crashes loses its mission; a repeated request would drive the robot a second time without an order.
For the same reason, an HMI that restarts during a run does not send the run's first mission: it
does not know what its predecessor received.

**Orders.** The Mission Manager publishes with each status which orders it would obey. The page
offers only these; it refuses others with the reason before they reach the bus. It repeats an order
as the identical message until the Mission Manager answers.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

from rampart.actors.bus import messages as bm
from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.operator.hmi import Hmi
from rampart.actors.operator.operating import Operating
from rampart.actors.operator.panels import Panel
from rampart.actors.operator.picture import MAX_NAME
from rampart.actors.operator.requests import REQUESTS, Name, Pending, RefusedError, Request
from rampart.actors.operator.state import HmiState
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.airport.model import Airport, Mission
from rampart.actors.osmosis.application import Osmosis
from rampart.actors.osmosis.control.mission.mission_state import first_id
from rampart.actors.osmosis.page.map import PageMap, lights_shown, page_map
from rampart.actors.osmosis.page.state import OsmosisState
from rampart.actors.runtime.actor import Actor, Context, Header, on
from rampart.actors.web.visitors import Role
from rampart.files.plain_text import one_line

RESPAWN_WINDOW_S = 8.0
"""Simulated time up to which a restarted HMI sends the first mission: its predecessor may have died
before it could."""

MISSION_GIVE_UP_S = 10.0
"""Time after which a mission that was not accepted is withdrawn."""

ORDER_GIVE_UP_S = 5.0
"""Simulated time after which an unanswered order is withdrawn."""

START_ANYWAY_S = 5.0
"""Simulated time after which the first mission is sent although a node does not run: missing nodes
are a matter of the fault tolerance."""

_BUSY = (m.MissionPhase.RUNNING, m.MissionPhase.PAUSED, m.MissionPhase.RETURNING)


def all_run(table: fm.NodeTable | None) -> bool:
    """Whether all nodes run, as far as the supervisor has reported."""
    return table is not None and all(
        row.state is fm.NodeState.RUNNING for row in table.nodes)


def system_is_up(table: fm.NodeTable | None, now_s: float) -> bool:
    """Whether a mission may be sent: simulated time has begun and all nodes run."""
    return now_s > START_ANYWAY_S or (now_s >= 0 and all_run(table))


class Submission(Pending[m.MissionRequest]):
    """The pending mission request.

    Args:
        run_id: id of this run; mission ids are derived from it.
        incarnation: incarnation of the page's node, counted from 1.
        now_s: simulated time at which this incarnation began.
        first: mission to send at the start of the run; None for none.
    """

    def __init__(self, run_id: str, incarnation: int, now_s: float, first: m.MissionRequest | None
                 ) -> None:
        super().__init__(f"{run_id}/{incarnation}",
                         "was not accepted: the Mission Manager does not answer", MISSION_GIVE_UP_S)
        self._status: m.MissionStatus | None = None
        self._first = first is not None and (incarnation == 1 or now_s < RESPAWN_WINDOW_S)
        if first is not None and self._first:
            self.put(f"mission {first.name}", first, math.inf)

    def hear(self, status: m.MissionStatus) -> None:
        """Take the Mission Manager's status; a request that it shows is settled.

        Any mission in the status settles the run's first one.
        """
        self._status = status
        if self.pending is not None and (
                status.mission_id == self.pending.mission_id
                or (self._first and status.mission_id)):
            self.settle()
            self._first = False

    def ask(self, name: str, goals: tuple[m.Goal, ...], now_s: float) -> m.MissionRequest:
        """Make a request of the operator pending.

        Raises:
            RefusedError: another mission runs or is pending.
        """
        mission_id = self.new_id()
        if self._status is not None and self._status.phase in _BUSY:
            raise RefusedError(f"mission {self._status.name} is {self._status.phase.value}")
        return self.put(f"mission {name}", m.MissionRequest(mission_id, name, goals), now_s)


def first_request(run_id: str, name: str, goals: tuple[m.Goal, ...]) -> m.MissionRequest:
    """Return the request for the first mission of a run."""
    return m.MissionRequest(first_id(run_id), name, goals)


NO_REASON = "asked for on the page"


class Orders(Pending[m.MissionOrder]):
    """The pending order.

    Args:
        prefix: prefix of the orders' ids, unique for each incarnation of the node.
        by: sender of the orders.
    """

    def __init__(self, prefix: str, by: str) -> None:
        super().__init__(
            prefix, "was not obeyed: the Mission Manager does not answer", ORDER_GIVE_UP_S)
        self._by = by
        self._status: m.MissionStatus | None = None

    def hear(self, status: m.MissionStatus) -> None:
        """Take the Mission Manager's status."""
        self._status = status

    def give(self, action: m.MissionAction, reason: str, now_s: float) -> m.MissionOrder:
        """Make an order of the operator pending.

        Raises:
            RefusedError: another order is pending, or the Mission Manager would refuse it.
        """
        order = self.new_id()
        if self._status is None:
            raise RefusedError("no status of the Mission Manager was received yet")
        if action not in self._status.orders:
            possible = ", ".join(self._status.orders) or "none"
            raise RefusedError(f"{action.value} is not possible while the mission is "
                               f"{self._status.phase.value}; possible: {possible}")
        return self.put(action.value, m.MissionOrder(
            order, action, " ".join(reason.split()) or NO_REASON, self._by), now_s)

    def answer(self, answer: m.MissionOrderAnswer) -> str:
        """Return the outcome of the pending order, or "" for an answer to another order."""
        if self.pending is None or answer.order != self.pending.order:
            return ""
        action = self.settle()
        return f"{action} obeyed" if answer.accepted else f"{action} refused: {answer.reason}"

class StartRequest(Request, frozen=True, tag="mission"):
    """Start a mission of the airport."""

    role = Role.DRIVE
    name: Name


class OrderRequest(Request, frozen=True, tag="order"):
    """Give an order to the mission under way."""

    role = Role.DRIVE
    action: m.MissionAction
    reason: Name = ""


OSMOSIS_REQUESTS: tuple[type[Request], ...] = (*REQUESTS, StartRequest, OrderRequest)


_STALE_S = 1.5
"""Simulated seconds after which the Safety Pilot is silent, but at least half a real one."""

_DRIVEN_BY = ("teleoperation", "safety_pilot")
"""Nodes between the page's joystick and the base."""


class Driving(Operating):
    """The operator's controls, and the effect of the joystick.

    Args:
        actor: the page's node.
        state: state of the pages; this class writes the section "operating".
        panels: panels of the page.
    """

    def __init__(self, actor: Actor, state: HmiState, panels: Sequence[Panel]) -> None:
        self._pilot: m.PilotStatus | None = None
        self._pilot_s = -math.inf
        self._brake = False
        self._dead: tuple[str, ...] = ()
        self._driven_by = tuple(p.title for p in panels if p.topic == topics.JOYSTICK.key)
        super().__init__(actor, state, panels)

    def pilot(self, message: m.PilotStatus) -> None:
        """Take the status of the Safety Pilot."""
        before, self._pilot, self._pilot_s = self._pilot, message, self._now()
        if before != message:
            self.show()

    def base(self, message: m.BaseStatus) -> None:
        """Take the state of the brake."""
        if message.brake_engaged != self._brake:
            self._brake = message.brake_engaged
            self.show()

    def nodes(self, table: fm.NodeTable) -> None:
        """Take the table of nodes: whether those between joystick and base run."""
        super().nodes(table)
        running = {row.name for row in table.nodes if row.state is fm.NodeState.RUNNING}
        dead = tuple(name for name in _DRIVEN_BY if name not in running)
        if dead != self._dead:
            self._dead = dead
            self.show()

    def diagnostic(self, report: bm.Diagnostic) -> None:
        """Take why Teleoperation ignores this joystick, e.g. because another one drives."""
        if (report.node == _DRIVEN_BY[0] and report.offender == self._actor.name
                and report.context == "joystick"):
            for panel in self._driven_by:
                self._sticks[panel].note = f"Teleoperation: {report.reason}"
            self.show()

    def effect(self, panel: str, now_s: float) -> tuple[bool, str]:
        """Return whether a panel's joystick has an effect now, and a text that explains it."""
        if panel not in self._driven_by:
            return super().effect(panel, now_s)
        pilot = self._pilot
        patience_s = max(_STALE_S, 0.5 * self._actor.clock.rate)
        return effect(
            pilot_heard=now_s - self._pilot_s <= patience_s, mode=pilot.mode if pilot else "",
            forbids=pilot.forbids if pilot else "", brake=self._brake, dead_nodes=self._dead)


def effect(*, pilot_heard: bool, mode: str, forbids: str, brake: bool, dead_nodes: tuple[str, ...]
           ) -> tuple[bool, str]:
    """Return whether the joystick has an effect now, and a text that explains it.

    Args:
        pilot_heard: whether the Safety Pilot's status is fresh.
        mode: mode of the Safety Pilot.
        forbids: why it forbids driving, or "".
        brake: whether the base's brake is engaged.
        dead_nodes: nodes between joystick and base that do not run.
    """
    for is_so, why in ((dead_nodes, f"{', '.join(dead_nodes)} does not run"),
                       (not pilot_heard, "the Safety Pilot is silent"),
                       (brake, "the brake is engaged (emergency stop)"),
                       (forbids, forbids)):
        if is_so:
            return False, f"no effect: {why}"
    if mode == "teleoperation":
        return True, "the robot obeys only the joystick; it stands while you release it"
    return True, "the joystick overrides the mission while you hold it"


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
        self._state.lights((message,))


def _goals(mission: Mission) -> tuple[m.Goal, ...]:
    return tuple(m.Goal(g.x_m, g.y_m, m.Mode(g.mode)) for g in mission.goals)
