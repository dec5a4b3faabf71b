"""DM13: actuator failure, by comparison of what the base is told with what it does."""

from __future__ import annotations

from rampart.actors.detection.module import DetectionModule
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.detection.actuator_failure_monitor import ActuatorMonitor, MotionLimits
from rampart.actors.runtime.actor import Context, Header, on
from rampart.manager.spec.tables import NonNegative

_FIRST_STATUS_S = 0.3
"""A respawned module waits this long for a first status of the base before it says idle."""


class ActuatorFailure(DetectionModule):
    """Active while wheels do not turn, or brakes do not brake, as the base was told."""

    class Parameters(DetectionModule.Parameters, frozen=True):
        """The base, and patience.

        Attributes:
            wheel_radius_m: of the base.
            hold_s: how long a finding stays without new evidence, s.
        """

        wheel_radius_m: NonNegative = MotionLimits().wheel_radius_m
        hold_s: NonNegative = MotionLimits().hold_s

    parameters: Parameters

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        system = context.run.system
        self.monitor = self.judged_by(ActuatorMonitor(
            MotionLimits(
                wheel_radius_m=self.parameters.wheel_radius_m,
                hold_s=self.parameters.hold_s,
                braking_mps2=system.robot.braking_mps2),
            self.known_after_s(_FIRST_STATUS_S)))

    @on(topics.BASE_COMMAND)
    def command(self, message: m.BaseCommand, _header: Header) -> None:
        """Hear what the base is told."""
        self.monitor.commanded(message.linear_mps, message.angular_radps, self.clock.now())

    @on(topics.GPS)
    def gps(self, message: m.GpsFix, _header: Header) -> None:
        """Hear how fast it is over ground."""
        self.monitor.moved(message.velocity_x_mps, message.velocity_y_mps, self.clock.now())

    @on(topics.BASE_STATUS)
    def status(self, message: m.BaseStatus, _header: Header) -> None:
        """Hear how the wheels turn, and judge."""
        self.monitor.status(message.wheel_speeds_radps, braking=message.brake_engaged,
                            now_s=self.clock.now())
        self.follow()
