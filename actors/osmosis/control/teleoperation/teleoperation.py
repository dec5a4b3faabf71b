"""Teleoperation: converts the joystick to a velocity command.

It is silent while the dead-man button is released, which ends the Safety Pilot's joystick mode. The
operator's page and `rampart joystick` publish `topics.JOYSTICK`; `stick_arbitration` selects one of
several sources.
"""

from __future__ import annotations

import math

import msgspec

from rampart.actors.operator.stick_arbitration import Ruling, StickArbiter
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.messages import Joystick, StickTwist
from rampart.actors.runtime.actor import Actor, Context, Header, on
from rampart.actors.runtime.timer import Timer
from rampart.manager.spec.tables import NonNegative

_LOOK_S = 0.05
"""Period for noticing a silent joystick (simulated seconds)."""


def stick_twist(stick: Joystick, max_linear_mps: float, max_angular_radps: float
                ) -> StickTwist | None:
    """Return the velocity for a joystick position; None while the dead man is released.

    Args:
        stick: positions in [-1, 1], else clipped; non-finite values count as released.
        max_linear_mps: speed at full deflection.
        max_angular_radps: turn rate at full deflection.
    """
    if not (stick.dead_man and math.isfinite(stick.forward) and math.isfinite(stick.left)):
        return None
    forward = min(max(stick.forward, -1.0), 1.0)
    left = min(max(stick.left, -1.0), 1.0)
    return StickTwist(forward * max_linear_mps, left * max_angular_radps)


class Teleoperation(Actor):
    """Converts each joystick position to a command at once. Sources repeat a held position."""

    class Parameters(Actor.Parameters, frozen=True):
        """Speeds.

        Attributes:
            linear_mps: speed at full deflection; by default the robot's.
            angular_radps: turn rate at full deflection; by default the robot's.
        """

        linear_mps: NonNegative | None = None
        angular_radps: NonNegative | None = None

    parameters: Parameters
    outputs = (topics.TELEOP_COMMAND,)

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        robot, own = context.run.system.robot, self.parameters
        self._linear_mps = robot.top_speed_mps if own.linear_mps is None else own.linear_mps
        self._angular_radps = (
            robot.top_turn_rate_radps if own.angular_radps is None else own.angular_radps)
        self._arbiter = StickArbiter(self.clock.now())
        self._look: Timer | None = None

    @on(topics.JOYSTICK)
    def joystick(self, message: Joystick, header: Header) -> None:
        """Take a position; publish its velocity if it is selected."""
        twist = stick_twist(message, self._linear_mps, self._angular_radps)
        ruling = self._arbiter.offer(
            header.source, twist is not None, header.stamp, self.clock.now())
        if twist is not None and ruling.follows:
            self.publish(topics.TELEOP_COMMAND, msgspec.structs.replace(
                twist, held_since_s=ruling.since_s), stamp=header.stamp)
        self._obey(ruling)
        self._attend()

    def _attend(self) -> None:
        """Look for silence while a joystick is held."""
        if self._arbiter.holder and self._look is None:
            self._look = self.call_later(_LOOK_S, self._again)

    def _obey(self, ruling: Ruling) -> None:
        """On release publish a final zero, so that the stop does not wait for a timeout."""
        if ruling.released and not ruling.follows:
            self.publish(topics.TELEOP_COMMAND, StickTwist(0.0, 0.0))
        if ruling.told:
            self.report_diagnostic("joystick", ruling.told, ruling.whom)

    def _again(self) -> None:
        self._look = None
        self._obey(self._arbiter.expire(self.clock.now()))
        self._attend()
