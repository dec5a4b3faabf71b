"""Teleoperation: converts the joystick to a velocity command.

It is silent while the dead-man button is released, which ends the Safety Pilot's joystick mode. The
joystick is a device of this machine, or a node that publishes `topics.JOYSTICK`;
`stick_arbitration` selects one of several.
"""

from __future__ import annotations

import math

import msgspec

from rampart.actors.operator.stick_arbitration import Ruling, StickArbiter
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.application import Osmosis
from rampart.actors.osmosis.control.teleoperation.joystick_device import (
    JoystickDevice,
    StickMapping,
)
from rampart.actors.osmosis.messages import Joystick, StickTwist
from rampart.actors.runtime.actor import Actor, Context, Header, on
from rampart.actors.runtime.timer import Timer
from rampart.manager.spec.tables import NonNegative

_LOOK_S = 0.05
"""Period for repeating a held joystick and noticing a silent one (simulated seconds)."""

_REPLUG_S = 0.5
"""Period for opening a missing device."""


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
    """Converts each joystick position to a command at once.

    A device reports only changes, so its position is repeated while the dead man is held; nodes
    repeat their messages. A device that fails counts as released, and is opened again.
    """

    class Parameters(Actor.Parameters, StickMapping, frozen=True):
        """Speeds and device, besides those of `StickMapping`.

        Attributes:
            linear_mps: speed at full deflection; by default the robot's.
            angular_radps: turn rate at full deflection; by default the robot's.
            device: path of a joystick, "auto" for the first one, "" for none.
        """

        linear_mps: NonNegative | None = None
        angular_radps: NonNegative | None = None
        device: str = ""

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
        self._named = Osmosis.of(context).options.joystick or own.device
        self._device = JoystickDevice(self._named, own, self._moved, self._gone)
        self._missing = ""

    def on_start(self) -> None:
        """Open the joystick, if one is configured."""
        if self._named and not self.context.run.plan.virtual:
            self._plug()

    def on_stop(self) -> None:
        """Close the joystick."""
        self._device.close()

    @on(topics.JOYSTICK)
    def joystick(self, message: Joystick, header: Header) -> None:
        """Take a position; publish its velocity if it is selected."""
        self._offer(header.source, message, header.stamp)

    def _offer(self, source: str, stick: Joystick, stamp_s: float) -> None:
        twist = stick_twist(stick, self._linear_mps, self._angular_radps)
        ruling = self._arbiter.offer(source, twist is not None, stamp_s, self.clock.now())
        if twist is not None and ruling.follows:
            self.publish(topics.TELEOP_COMMAND, msgspec.structs.replace(
                twist, held_since_s=ruling.since_s), stamp=stamp_s)
        self._obey(ruling)
        self._attend()

    def _attend(self) -> None:
        """Schedule `_again` while a joystick is held."""
        if (self._device.stick.dead_man or self._arbiter.holder) and self._look is None:
            self._look = self.call_later(_LOOK_S, self._again)

    def _obey(self, ruling: Ruling) -> None:
        """On release publish a final zero, so that the stop does not wait for a timeout."""
        if ruling.released and not ruling.follows:
            self.publish(topics.TELEOP_COMMAND, StickTwist(0.0, 0.0))
        if ruling.told:
            self.report_diagnostic("joystick", ruling.told, ruling.whom)

    def _again(self) -> None:
        """Repeat a held device, and release a silent joystick."""
        self._look = None
        if self._device.stick.dead_man:
            self._moved()
        else:
            self._obey(self._arbiter.expire(self.clock.now()))
        self._attend()

    # -- the device -----------------------------------------------------------------------------

    def _plug(self) -> None:
        missing = self._device.open()
        if missing and missing != self._missing:
            self.report_diagnostic(
                "joystick", f"waiting for the device: {missing}", self._device.path)
        self._missing = missing
        if missing:
            self.call_later(_REPLUG_S, self._plug)
        else:
            self._moved()  # a button that is already down counts as released

    def _moved(self) -> None:
        self._offer(self._device.path, self._device.stick, self.clock.now())

    def _gone(self, why: str) -> None:
        self._moved()  # a closed device is released
        self.report_diagnostic("joystick", f"lost: {why}", self._device.path)
        self._missing = why
        self.call_later(_REPLUG_S, self._plug)
