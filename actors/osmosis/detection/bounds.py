"""DM3: wrong command value (paper, table I): a velocity beyond the robot's limits."""

from __future__ import annotations

import math

from rampart.actors.detection.finding import Sustained
from rampart.actors.detection.module import DetectionModule
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.runtime.actor import Context, Header, on
from rampart.actors.runtime.parameters import NodeNames

_ROUNDING = 1e-6
"""Rounding of a command that was clamped to the limit in float32."""


def beyond(linear_mps: float, angular_radps: float, top_mps: float, top_radps: float) -> str:
    """Return which bound a command exceeds, or "".

    Args:
        linear_mps: commanded speed, m/s.
        angular_radps: commanded turn rate, rad/s.
        top_mps: top speed, m/s, forward and backward.
        top_radps: top turn rate, rad/s, either way.
    """
    for what, value, limit, unit in (("speed", linear_mps, top_mps, "m/s"),
                                     ("turn rate", angular_radps, top_radps, "rad/s")):
        if not math.isfinite(value):
            return f"commanded {what} is {value}"
        if abs(value) > limit * (1 + _ROUNDING) + _ROUNDING:
            return f"commanded {what} {value:.2f} {unit} exceeds {limit:g} {unit}"
    return ""


_FIRST_COMMAND_S = 0.2
"""Time that a restarted module waits for a command, four periods, before it reports idle."""

_HOLD_S = 0.5
"""Time that commands must have been valid again before the module is idle."""


class Bounds(DetectionModule):
    """Active while Osmosis Control's command exceeds the robot's top speed or top turn rate.

    It is active from the first wrong command until commands have been valid for a while; silence
    after a wrong command does not end it.
    """

    class Parameters(DetectionModule.Parameters, frozen=True):
        """Parameters.

        Attributes:
            suspects: nodes to name for a recovery that restarts, with the incarnation that sent
                the wrong command: Osmosis Control. None by default.
        """

        suspects: NodeNames = ()

    parameters: Parameters

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._robot = context.run.system.robot
        self.monitor = self.judged_by(Sustained(
            0.0, _HOLD_S, self.known_after_s(_FIRST_COMMAND_S)))

    @on(topics.COMMAND)
    def command(self, message: m.Twist, header: Header) -> None:
        """Check a command."""
        fault = beyond(message.linear_mps, message.angular_radps,
                       self._robot.top_speed_mps, self._robot.top_turn_rate_radps)
        self.monitor.note(fault, self.clock.now())
        if fault:  # names the newest wrong incarnation, with the first reason
            self.monitor.nodes = tuple(
                f"{n}#{header.incarnation}" for n in self.parameters.suspects)
        self.follow()
