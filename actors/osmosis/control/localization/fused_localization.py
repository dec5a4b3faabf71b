"""Localization by fusion of odometry, IMU, GPS and absolute pose, any one of which may fail.

It replaces the paper's localization (`localization.localization`) if the spec names it. A new
process starts from the first absolute pose and fix. Its checkpoint holds one value: the distance
that contradicted positions still have to move like the wheels. Without it, a successor would use
the positions that its predecessor had excluded.
"""

from __future__ import annotations

import math

import msgspec

from rampart.actors.osmosis import topics
from rampart.actors.osmosis.control.localization.pose_filter import FilterLimits, PoseFilter
from rampart.actors.osmosis.messages import BaseStatus, GpsFix, Imu, Odometry, Pose
from rampart.actors.runtime.actor import Actor, Context, Header, every, on
from rampart.actors.runtime.checkpoint import StateFormat
from rampart.manager.spec.tables import NonNegative

_PERIOD_S = 0.05
_KEEP_EACH_M = 1.0


class LocalizationKept(msgspec.Struct, frozen=True):
    """State of the localization.

    Attributes:
        owed_m: see `PoseFilter`.
    """

    owed_m: float = 0.0


def _objection(kept: LocalizationKept) -> str:
    return "" if 0.0 <= kept.owed_m < math.inf else f"owed_m = {kept.owed_m}: must be 0 or more"


LOCALIZATION_STATE = StateFormat(LocalizationKept, version=1, objection=_objection)


class FusedLocalization(Actor):
    """Publishes the fused pose with the stamp of its newest accepted reading.

    While the pose is unknown it publishes none, so that readers and DM6 see a stale pose.
    """

    class Parameters(Actor.Parameters, frozen=True):
        """Parameters.

        Attributes:
            bridge_m: longest distance on dead reckoning alone, m.
        """

        bridge_m: NonNegative = FilterLimits().bridge_m

    parameters: Parameters
    outputs = (topics.POSE, topics.LOCALIZATION_STATUS)

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._filter = PoseFilter(FilterLimits(self.parameters.bridge_m))
        self._published_s = -math.inf
        self._kept_m = 0.0

    def on_start(self) -> None:
        """Restore the checkpoint."""
        if (kept := self.kept(LOCALIZATION_STATE)) is not None:
            self._kept_m = self._filter.owed_m = kept.owed_m
        self.keep(LOCALIZATION_STATE, LocalizationKept(self._kept_m))

    @on(topics.BASE_STATUS)
    def status(self, message: BaseStatus, header: Header) -> None:
        """Take the wheel speeds."""
        self._filter.encoders(header.stamp, message, self.clock.now())

    @on(topics.IMU)
    def imu(self, message: Imu, header: Header) -> None:
        """Take a reading of the IMU."""
        self._filter.imu(header.stamp, message, self.clock.now())

    @on(topics.ODOMETRY)
    def odometry(self, message: Odometry, header: Header) -> None:
        """Take odometry."""
        self._filter.odometry(header.stamp, message, self.clock.now())

    @on(topics.ABSOLUTE_POSE)
    def absolute_pose(self, message: Pose, header: Header) -> None:
        """Take an absolute pose."""
        self._filter.absolute_pose(header.stamp, message, self.clock.now())
        self._publish_first()

    @on(topics.GPS)
    def gps(self, message: GpsFix, header: Header) -> None:
        """Take a fix."""
        self._filter.gps(header.stamp, message, self.clock.now())
        self._publish_first()

    @every(_PERIOD_S)
    def publish_pose(self) -> None:
        """Publish the pose if there is a newer one."""
        owed_m = self._filter.owed_m
        if owed_m > self._kept_m or self._kept_m - owed_m >= (_KEEP_EACH_M if owed_m else 1e-9):
            self._kept_m = owed_m
            self.keep(LOCALIZATION_STATE, LocalizationKept(owed_m))
        estimate = self._filter.estimate()
        if estimate is not None and estimate.stamp_s > self._published_s:
            self._published_s = estimate.stamp_s
            self.publish(topics.POSE, estimate.pose, stamp=estimate.stamp_s)

    @every(0.2)
    def repeat(self) -> None:
        """Publish the sources of the pose and its uncertainty."""
        self.publish(topics.LOCALIZATION_STATUS, self._filter.status(self.clock.now()))

    def _publish_first(self) -> None:
        """Publish the first pose at once, so that a restart costs no extra period."""
        if self._published_s == -math.inf:
            self.publish_pose()
