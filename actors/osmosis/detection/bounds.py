"""DM3: wrong command value (paper, table I): no velocity that the robot could be meant to drive."""

from __future__ import annotations

import math

from rampart.actors.detection.finding import Sustained
from rampart.actors.detection.module import DetectionModule
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.runtime.actor import Context, Header, on
from rampart.actors.runtime.parameters import NodeNames
from rampart.manager.spec.tables import NonNegative

_ROUNDING = 1e-6
"""A command clamped to the limit elsewhere, in float32 perhaps, is within it."""


def beyond(linear_mps: float, angular_radps: float, top_mps: float, top_radps: float) -> str:
    """Return which bound a command breaks, "" if none.

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
"""A respawned module waits this long for a first command, four periods, before it says idle."""


class Bounds(DetectionModule):
    """Active while Osmosis Control commands what the robot was never meant to drive.

    The limits are the robot's top speed and top turn rate in the system spec. Active from the first
    bad command until they have been good for `hold_s`; a source that sent nonsense and then nothing
    is not cured.
    """

    class Parameters(DetectionModule.Parameters, frozen=True):
        """What it reports, and for how long.

        Attributes:
            hold_s: how long commands must have been good again before the module is idle, s.
            suspects: whom to name when it is active, for a recovery that respawns: Osmosis
                Control, by the incarnation that sent the bad command. By default nobody is named.
        """

        hold_s: NonNegative = 0.5
        suspects: NodeNames = ()

    parameters: Parameters

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._robot = context.run.system.robot
        self.monitor = self.judged_by(Sustained(
            0.0, self.parameters.hold_s, self.known_after_s(_FIRST_COMMAND_S)))

    @on(topics.COMMAND)
    def command(self, message: m.Twist, header: Header) -> None:
        """Check a command."""
        fault = beyond(message.linear_mps, message.angular_radps,
                       self._robot.top_speed_mps, self._robot.top_turn_rate_radps)
        self.monitor.note(fault, self.clock.now())
        if fault:  # the newest that is bad is named, by the first one's reason
            self.monitor.nodes = tuple(
                f"{n}#{header.incarnation}" for n in self.parameters.suspects)
        self.follow()
