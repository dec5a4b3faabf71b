"""DM3: wrong command value (paper, table I)."""

from __future__ import annotations

from rampart.actors.detection.module import DetectionModule
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.detection.bounds_check import BoundsCheck
from rampart.actors.runtime.actor import Context, Header, on
from rampart.actors.runtime.parameters import NodeNames
from rampart.manager.spec.tables import NonNegative

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
            self.parameters.hold_s,
            self.known_after_s(_FIRST_COMMAND_S)))

    @on(topics.COMMAND)
    def command(self, message: m.Twist, header: Header) -> None:
        """Check a command."""
        was_active = self.monitor.active
        self.monitor.command(message.linear_mps, message.angular_radps, self.clock.now())
        if not self.monitor.active:
            self.monitor.nodes = ()
        elif not was_active or not self.monitor.good:
            self.monitor.nodes = tuple(
                f"{n}#{header.incarnation}" for n in self.parameters.suspects)
        self.follow()
