"""DM3: wrong command value (paper, table I)."""

from __future__ import annotations

import math

from actors import messages as m
from actors import topics
from actors.detection.bounds_check import BoundsCheck
from actors.detection.module import DetectionModule, number
from actors.runtime.actor import Context, Header, on
from manager.schema import SystemSpec

_FIRST_COMMAND_S = 0.2
"""A respawned module waits this long for a first command, four periods, before it says idle."""


class Bounds(DetectionModule):
    """Active while Osmosis Control commands what the robot was never meant to drive.

    The limits are the robot's top speed and top turn rate in the system spec.

    Parameters:
        hold_s: how long commands must have been good again before the module is idle, s.
    """

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        system: SystemSpec = context.shared["system"]
        self.monitor = BoundsCheck(
            system.robot.top_speed_mps, system.robot.top_turn_rate_radps,
            number(self.parameters, "hold_s", 0.5),
            -math.inf if self.first_life else self.clock.now() + _FIRST_COMMAND_S)

    def on_start(self) -> None:
        """Start waiting for the first command."""
        self.follow(self.monitor)

    @on(topics.COMMAND)
    def command(self, message: m.Twist, _header: Header) -> None:
        """Check a command."""
        self.monitor.command(message.linear_mps, message.angular_radps, self.clock.now())
        self.follow(self.monitor)
