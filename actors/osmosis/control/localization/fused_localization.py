"""Localization by fusion: odometry, IMU, GPS and the absolute pose, any one of which may fail.

In the place of `rampart.actors.osmosis.control.localization.localization`, the paper's, if a
system's spec says so. It keeps nothing that a restart would lose: a new process starts from the
first absolute pose and fix.
"""

from __future__ import annotations

import math

from rampart.actors.osmosis import topics
from rampart.actors.osmosis.control.localization.pose_filter import PoseFilter
from rampart.actors.osmosis.control.localization.position_source import FilterLimits
from rampart.actors.osmosis.messages import GpsFix, Imu, Odometry, Pose
from rampart.actors.runtime.actor import Actor, Context, Header, every, on
from rampart.manager.spec.tables import NonNegative

_PERIOD_S = 0.05


class FusedLocalization(Actor):
    """Publishes the fused pose with the stamp of its newest accepted reading.

    It publishes none while it does not know one, so that a reader, and DM6, sees it grow old.
    """

    class Parameters(Actor.Parameters, frozen=True):
        """How far it is trusted.

        Attributes:
            bridge_m: how far the robot may go on dead reckoning alone, m.
        """

        bridge_m: NonNegative = FilterLimits().bridge_m

    parameters: Parameters
    outputs = (topics.POSE, topics.LOCALIZATION_STATUS)

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._filter = PoseFilter(FilterLimits(self.parameters.bridge_m))
        self._told_s = -math.inf

    @on(topics.IMU)
    def imu(self, message: Imu, header: Header) -> None:
        """Take a reading of the gyro."""
        self._filter.imu(header.stamp, message, self.clock.now())

    @on(topics.ODOMETRY)
    def odometry(self, message: Odometry, header: Header) -> None:
        """Take a reading of the wheels."""
        self._filter.odometry(header.stamp, message, self.clock.now())

    @on(topics.ABSOLUTE_POSE)
    def absolute_pose(self, message: Pose, header: Header) -> None:
        """Take an absolute pose."""
        self._filter.absolute_pose(header.stamp, message, self.clock.now())
        self._tell_first()

    @on(topics.GPS)
    def gps(self, message: GpsFix, header: Header) -> None:
        """Take a fix."""
        self._filter.gps(header.stamp, message, self.clock.now())
        self._tell_first()

    @every(_PERIOD_S)
    def tell(self) -> None:
        """Publish the pose, if there is a newer one."""
        estimate = self._filter.estimate()
        if estimate is not None and estimate.stamp_s > self._told_s:
            self._told_s = estimate.stamp_s
            self.publish(topics.POSE, estimate.pose, stamp=estimate.stamp_s)

    @every(0.2)
    def repeat(self) -> None:
        """Say what the pose rests on."""
        self.publish(topics.LOCALIZATION_STATUS, self._filter.status(self.clock.now()))

    def _tell_first(self) -> None:
        """Publish the first pose at once, so that a respawn costs no extra period."""
        if self._told_s == -math.inf:
            self.tell()
