"""Teleoperation: the operator's stick as a velocity command.

Silent while the dead-man button is released, so the Safety Pilot's joystick mode ends with it.
"""

from __future__ import annotations

import math

from actors import topics
from actors.messages import Joystick, Twist
from actors.runtime.actor import Actor, Context, Header, on


def stick_twist(stick: Joystick, max_linear_mps: float, max_angular_radps: float) -> Twist | None:
    """Return the velocity for a stick position, None while the dead man is released.

    Args:
        stick: positions in [-1, 1]; beyond, they are cut; not finite counts as released.
        max_linear_mps: speed at full stick.
        max_angular_radps: turn rate at full stick.
    """
    if not (stick.dead_man and math.isfinite(stick.forward) and math.isfinite(stick.left)):
        return None
    forward = min(max(stick.forward, -1.0), 1.0)
    left = min(max(stick.left, -1.0), 1.0)
    return Twist(forward * max_linear_mps, left * max_angular_radps)


class Teleoperation(Actor):
    """Turns each stick position into a command at once.

    Parameters: `linear_mps`, `angular_radps`: velocities at full stick; the robot's if left out.
    """

    outputs = (topics.TELEOP_COMMAND,)

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        robot = context.shared["system"].robot
        self._linear_mps = float(context.parameters.get("linear_mps", robot.top_speed_mps))
        self._angular_radps = float(
            context.parameters.get("angular_radps", robot.top_turn_rate_radps))
        self._held = False

    @on(topics.JOYSTICK)
    def joystick(self, message: Joystick, header: Header) -> None:
        """Publish the stick's velocity; on release one last zero, so the stop does not wait."""
        twist = stick_twist(message, self._linear_mps, self._angular_radps)
        if twist is not None:
            self.publish(topics.TELEOP_COMMAND, twist, stamp=header.stamp)
        elif self._held:
            self.publish(topics.TELEOP_COMMAND, Twist(0.0, 0.0))
        self._held = twist is not None
