"""The flight controller: from the goal to the acceleration that it demands of the pilots."""

from __future__ import annotations

import math

from quadrotor import topics as t
from quadrotor.control import PositionControl
from rampart import Actor, Context, Header, on

_GOAL_S = 1.0


class FlightController(Actor):
    """Answers each estimate with a setpoint. Without a fresh goal it brakes and hovers."""

    outputs = (t.SETPOINT,)

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._control = PositionControl()
        self._goal: t.Goal | None = None
        self._goal_s = -math.inf
        self._heeded = True

    @on(t.GOAL)
    def goal(self, message: t.Goal, header: Header) -> None:
        """Take a goal."""
        if all(map(math.isfinite, (message.x_m, message.y_m, message.z_m, message.yaw_rad,
                                   message.speed_mps, message.descent_mps))):
            self._goal, self._goal_s = message, header.stamp

    @on(t.PILOT)
    def pilot(self, message: t.PilotStatus, _header: Header) -> None:
        """Let the integrals rest while the pilot does not follow the setpoint."""
        self._heeded = message.source == "setpoint" and not message.landed
        if message.landed:
            self._control.reset()

    @on(t.ESTIMATE)
    def estimate(self, at: t.Estimate, _header: Header) -> None:
        """Publish the acceleration towards the goal."""
        goal = self._goal
        if goal is None or not math.isfinite(at.speed_mps + at.x_m + at.y_m + at.z_m):
            return
        step_s = 1 / t.ESTIMATE.rate_hz if self._heeded else 0.0
        if self.clock.now() - self._goal_s > _GOAL_S and goal.fly:
            accel = self._control.towards((0.0, 0.0, 0.0), at, step_s)
        else:
            accel = self._control.step(goal, at, step_s)
        self.publish(t.SETPOINT, t.Setpoint(goal.fly, *accel, goal.yaw_rad))
