"""Mission Manager: takes a mission and publishes its goals one by one."""

from __future__ import annotations

import math

import msgspec

from rampart.actors.bus.bounds import clip
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.ftm.messages import ManagerStatus
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.application import Osmosis
from rampart.actors.osmosis.control.mission import mission_state
from rampart.actors.osmosis.control.mission.mission_state import MISSION_STATE, MissionState
from rampart.actors.runtime.actor import Actor, Context, Header, every, on
from rampart.actors.runtime.parameters import RecoveryNames

UNCERTAIN_S = 1.0
"""Time that a restarted Mission Manager waits for the step of planner or control. They repeat it
five times a second, and at once for a new subscriber."""

_SAME_POINT_M = 0.1
"""Greatest distance between a goal and the end of a route to it."""


class MissionManager(Actor):
    """Wires the state machine `mission_state` to its topics.

    The FTM Manager's status gives the recoveries that hold the robot, ten times a second, also to a
    restarted Mission Manager.
    """

    class Parameters(Actor.Parameters, frozen=True):
        """Parameters.

        Attributes:
            held_by: recovery modules that hold the robot while they are activated; the mission is
                paused meanwhile. None by default, as in the paper.
        """

        held_by: RecoveryNames = ()

    parameters: Parameters
    outputs = (topics.GOAL, topics.MISSION_STATUS, topics.MISSION_ORDER_ANSWER)

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self.state = MissionState()
        self._uncertain_until_s = -math.inf
        self._lights = frozenset(light.name for light in Osmosis.of(context).airport.lights)

    @on(topics.MISSION_REQUEST)
    def request(self, message: m.MissionRequest, _header: Header) -> None:
        """Take a mission, unless it was accepted before."""
        first = message.mission_id == mission_state.first_id(self.context.run.plan.run_id)
        self._become(mission_state.accept(self.state, message, self.clock.now(), first=first))

    @on(topics.MISSION_ORDER)
    def order(self, message: m.MissionOrder, _header: Header) -> None:
        """Execute or refuse an order, and answer."""
        state, answer = mission_state.obey(self.state, message, self.clock.now())
        self._become(state)
        self.publish(topics.MISSION_ORDER_ANSWER, answer)

    @on(ftm_topics.MANAGER_STATUS)
    def manager(self, message: ManagerStatus, _header: Header) -> None:
        """Pause while a recovery holds the robot."""
        if held_by := self.parameters.held_by:
            self._become(mission_state.hold(self.state, hold_reason(message, held_by)))

    @on(topics.CONTROL_STATUS)
    def progress(self, message: m.ControlStatus, _header: Header) -> None:
        """Advance when the current goal is reached."""
        self._compare(message.mission_id, message.step)
        message = msgspec.structs.replace(message, unmeasured=tuple(
            name for name in message.unmeasured if name in self._lights))
        self._become(mission_state.progress(self.state, message, self.clock.now()))

    @on(topics.ROUTE)
    def route(self, message: m.Route, _header: Header) -> None:
        """Fail if there is no route."""
        self._compare(message.mission_id, message.step, message.waypoints[-1:])
        self._become(mission_state.routed(self.state, message))

    @on(topics.LIGHT_MEASURED)
    def light(self, message: m.LightMeasurement, _header: Header) -> None:
        """Keep the measurement of a light of the airport."""
        if message.light not in self._lights:
            self.report_diagnostic("light", "not a light of this airport", message.light)
            return
        self._become(mission_state.measured(self.state, message))

    def on_start(self) -> None:
        """Restore the checkpoint and publish status and goal.

        The checkpoint may be outdated. So status and goal are withheld until planner or control
        have reported their step, or `UNCERTAIN_S` has passed.
        """
        if (state := self.kept(MISSION_STATE)) is not None:
            self.state = state
            if state.phase in mission_state.ACTIVE:
                self._uncertain_until_s = self.clock.now() + UNCERTAIN_S
        self.repeat_status()
        self.repeat_goal()

    @every(0.2)
    def repeat_goal(self) -> None:
        """Repeat the goal."""
        if self.clock.now() >= self._uncertain_until_s:
            self.publish(topics.GOAL, mission_state.goal_order(self.state))

    @every(1.0)
    def remember(self) -> None:
        """Save the state, again if that failed."""
        self.keep(MISSION_STATE, self.state)

    def _compare(self, mission_id: str, step: int,
                 end: tuple[tuple[float, float], ...] = ()) -> None:
        """End the uncertainty after a restart with the step of planner or control.

        A later step than the checkpoint's is accepted only with a route to that step's goal: the
        former process may have crashed after it published a wrong goal.
        """
        if self.clock.now() < self._uncertain_until_s and mission_id == self.state.mission_id:
            goals = self.state.goals[step:step + 1]
            if step > self.state.step and not any(
                    math.dist(point, (goal.x_m, goal.y_m)) < _SAME_POINT_M
                    for point, goal in zip(end, goals, strict=False)):
                return
            self._uncertain_until_s = -math.inf
            self._become(mission_state.catch_up(self.state, step, self.clock.now()))
            self.repeat_status()
            self.repeat_goal()

    @every(0.5)
    def repeat_status(self) -> None:
        """Repeat the status."""
        if self.clock.now() >= self._uncertain_until_s:
            self.publish(topics.MISSION_STATUS, mission_state.status(self.state))

    def _become(self, state: MissionState) -> None:
        if state is self.state:
            return
        before, self.state = self.state, state
        self.remember()  # before a node acts on it
        self.repeat_status()
        order = mission_state.goal_order(state)
        if order != mission_state.goal_order(before):
            self.repeat_goal()


def hold_reason(status: ManagerStatus, holding: tuple[str, ...]) -> str:
    """Return which recoveries hold the robot and why, or ""."""
    held_by = [name for name in holding if name in status.activated]
    if not held_by:
        return ""
    causes = [f"{view.name}: {view.reason}" for view in status.detections if view.active]
    return clip(f"held by {' and '.join(held_by)}" + (f": {'; '.join(causes)}" if causes else ""))
