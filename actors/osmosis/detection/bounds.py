"""DM3: wrong command value (paper, table I): no velocity that the robot could be meant to drive."""

from __future__ import annotations

import math

from rampart.actors.detection.finding import Finding
from rampart.actors.detection.lasting import Lasting
from rampart.actors.detection.module import DetectionModule
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.runtime.actor import Context, Header, on
from rampart.actors.runtime.parameters import NodeNames
from rampart.manager.spec.tables import NonNegative

_ROUNDING = 1e-6
"""A command clamped to the limit elsewhere, in float32 perhaps, is within it."""


class BoundsCheck(Finding):
    """Active from the first bad command until commands have been good for `hold_s`.

    Silence does not make it idle: a source that sent nonsense and then nothing is not cured.

    Args:
        max_linear_mps: top speed, m/s, forward and backward.
        max_angular_radps: top turn rate, rad/s, either way.
        hold_s: how long commands must have been good, s.
        known_after_s: when idle may be claimed without a command heard; -inf for at once.
    """

    def __init__(self, max_linear_mps: float, max_angular_radps: float, hold_s: float,
                 known_after_s: float = -math.inf) -> None:
        super().__init__(known_after_s)
        self.max_linear_mps = max_linear_mps
        self.max_angular_radps = max_angular_radps
        self._good = Lasting(hold_s)

    @property
    def good(self) -> bool:
        """Whether the last command was good."""
        return not self.active or self._good.since_s < math.inf

    def command(self, linear_mps: float, angular_radps: float, now_s: float) -> None:
        """Check a command."""
        self.known = True
        fault = self._fault(linear_mps, angular_radps)
        cured = self._good.note(not fault, now_s)
        if fault:
            self.reason = self.reason or fault
        elif cured:
            self.clear()

    def _fault(self, linear_mps: float, angular_radps: float) -> str:
        for what, value, limit, unit in (
                ("speed", linear_mps, self.max_linear_mps, "m/s"),
                ("turn rate", angular_radps, self.max_angular_radps, "rad/s")):
            if not math.isfinite(value):
                return f"commanded {what} is {value}"
            if abs(value) > limit * (1 + _ROUNDING) + _ROUNDING:
                return f"commanded {what} {value:.2f} {unit} exceeds {limit:g} {unit}"
        return ""


_FIRST_COMMAND_S = 0.2
"""A respawned module waits this long for a first command, four periods, before it says idle."""


class Bounds(DetectionModule):
    """Active while Osmosis Control commands what the robot was never meant to drive.

    The limits are the robot's top speed and top turn rate in the system spec.
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
        system = context.run.system
        self.monitor = self.judged_by(BoundsCheck(
            system.robot.top_speed_mps, system.robot.top_turn_rate_radps,
            self.parameters.hold_s, self.known_after_s(_FIRST_COMMAND_S)))

    @on(topics.COMMAND)
    def command(self, message: m.Twist, header: Header) -> None:
        """Check a command."""
        was_active = self.monitor.active
        self.monitor.command(message.linear_mps, message.angular_radps, self.clock.now())
        if self.monitor.active and not (was_active and self.monitor.good):
            self.monitor.nodes = tuple(
                f"{n}#{header.incarnation}" for n in self.parameters.suspects)
        self.follow()
