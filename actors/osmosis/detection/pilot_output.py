"""DM12: the Safety Pilot's output is wrong, or is not there."""

from __future__ import annotations

import math

from rampart.actors.detection.module import DetectionModule, Waiting
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.detection.pilot_output_monitor import PilotLimits, PilotOutputMonitor
from rampart.actors.runtime.actor import Context, Header, on
from rampart.actors.runtime.parameters import ControlTimeout, NodeName
from rampart.manager.spec.tables import NonNegative


class PilotOutput(DetectionModule):
    """Compares what the base gets with what the Safety Pilot was asked for and says it does.

    Names the pilot's life, so that it can be respawned: an error of software that sits in its
    process goes with it.
    """

    class Parameters(Waiting, frozen=True):
        """Whom it checks, and how strictly.

        Attributes:
            pilot: name of the Safety Pilot's node.
            timeout_s: how old the newest command for the base may be; below the base's dead man.
            wrong_s: how long commands for the base may be without explanation, s.
            hold_s: how long all must have been well again before the module is idle, s.
        """

        pilot: NodeName = "safety_pilot"
        timeout_s: ControlTimeout = PilotLimits().timeout_s
        wrong_s: NonNegative = PilotLimits().wrong_s
        hold_s: NonNegative = PilotLimits().hold_s

    parameters: Parameters

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        system, parameters = context.run.system, self.parameters
        limits = PilotLimits(
            # As the Safety Pilot has it: without its checks it goes on for ever.
            held_s=(system.timing.command_timeout_s if system.layers.safety_pilot_checks
                    else math.inf),
            timeout_s=parameters.timeout_s,
            wrong_s=parameters.wrong_s,
            hold_s=parameters.hold_s)
        self.monitor = self.judged_by(PilotOutputMonitor(
            parameters.pilot, self.clock.now(), self.grace_s(limits.timeout_s), limits,
            known=self.first_life))

    @on(topics.COMMAND)
    def command(self, message: m.Twist, _header: Header) -> None:
        """Hear what Osmosis Control asks for."""
        self.monitor.asked(message.linear_mps, message.angular_radps, self.clock.now(), "active")

    @on(topics.STANDBY_COMMAND)
    def standby(self, message: m.Twist, _header: Header) -> None:
        """Hear what its standby asks for."""
        self.monitor.asked(message.linear_mps, message.angular_radps, self.clock.now(), "standby")

    @on(topics.TELEOP_COMMAND)
    def joystick(self, message: m.Twist, _header: Header) -> None:
        """Hear what the operator asks for."""
        self.monitor.asked(message.linear_mps, message.angular_radps, self.clock.now())

    @on(topics.PILOT_STATUS)
    def status(self, message: m.PilotStatus, _header: Header) -> None:
        """Hear what the Safety Pilot says that it does."""
        self.monitor.said(stopped=message.stopped, reason=message.reason, now_s=self.clock.now())

    @on(topics.BASE_COMMAND)
    def sent(self, message: m.BaseCommand, header: Header) -> None:
        """Hear what the base gets."""
        self.monitor.sent(message.linear_mps, message.angular_radps, header.stamp,
                          header.incarnation, self.clock.now())
        self.follow()
