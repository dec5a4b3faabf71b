"""Mission Manager: takes a mission and gives its goals one by one."""

from __future__ import annotations

from actors import topics
from actors.control import mission_state
from actors.control.mission_state import MissionState
from actors.messages import ControlStatus, LightMeasurement, MissionRequest, Route
from actors.runtime.actor import Actor, Context, Header, every, on


class MissionManager(Actor):
    """Wires `mission_state` to its topics; see there for the machine."""

    outputs = (topics.GOAL, topics.MISSION_STATUS)

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self.state = MissionState()

    @on(topics.MISSION_REQUEST)
    def request(self, message: MissionRequest, _header: Header) -> None:
        """Take a mission, unless it was taken before."""
        self._become(mission_state.accept(self.state, message, self.clock.now()))

    @on(topics.CONTROL_STATUS)
    def progress(self, message: ControlStatus, _header: Header) -> None:
        """Step on when the current goal is reached."""
        self._become(mission_state.progress(self.state, message, self.clock.now()))

    @on(topics.ROUTE)
    def route(self, message: Route, _header: Header) -> None:
        """Give up when there is no way."""
        self._become(mission_state.routed(self.state, message))

    @on(topics.LIGHT_MEASURED)
    def light(self, message: LightMeasurement, _header: Header) -> None:
        """Keep a light's measurement."""
        self._become(mission_state.measured(self.state, message))

    def on_start(self) -> None:
        """Say at once how things stand."""
        self.repeat_status()
        self.repeat_goal()

    @every(0.2)
    def repeat_goal(self) -> None:
        """Repeat the goal for whoever joined late."""
        self.publish(topics.GOAL, mission_state.goal_order(self.state))

    @every(0.5)
    def repeat_status(self) -> None:
        """Repeat the status for whoever joined late."""
        self.publish(topics.MISSION_STATUS, mission_state.status(self.state))

    def _become(self, state: MissionState) -> None:
        if state is self.state:
            return
        before, self.state = self.state, state
        self.publish(topics.MISSION_STATUS, mission_state.status(state))
        order = mission_state.goal_order(state)
        if order != mission_state.goal_order(before):
            self.publish(topics.GOAL, order)
