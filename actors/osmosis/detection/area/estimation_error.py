"""DM8: error in localization estimation (paper, figure 5, where this event has no mechanism).

Freshness and heartbeat detect a silent or dead localization. This module detects a wrong one: it
compares the pose with GPS, wheels and IMU. The pose is wrong if GPS and wheels agree with each
other and not with it; a wrong GPS alone does not activate it. It names the incarnation that
published the pose, so that no later one is restarted.
"""

from __future__ import annotations

import math

from rampart.actors.detection.finding import Finding
from rampart.actors.detection.module import DetectionModule
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.detection.area.position_vote import PositionVote
from rampart.actors.osmosis.readings import is_pose
from rampart.actors.runtime.actor import Context, Header, on

_POSE = "localization"
_TURNED_RAD = 0.3
_TURNED_FIXES = 3


class EstimationMonitor(Finding):
    """Active while the pose is outvoted in its position, or in its heading while the robot drives.

    The heading is compared with the IMU's and with the course over ground.

    Args:
        known_after_s: time from which it may be idle without a comparison, -inf for at once; DM6
            and DM1 detect missing inputs.
    """

    def __init__(self, known_after_s: float) -> None:
        super().__init__(known_after_s)
        self.vote = PositionVote(_POSE, aligned=known_after_s == -math.inf)
        self._yaw_rad = 0.0
        self._turned = 0

    def pose(self, pose: m.Pose, stamp_s: float, now_s: float, suspect: str) -> None:
        """Take the checked pose; `suspect` is the incarnation that published it."""
        if is_pose(pose) and self.vote.see_position(stamp_s, (pose.x_m, pose.y_m), now_s):
            self._yaw_rad = pose.yaw_rad
            if not self.active:
                self.nodes = (suspect,)

    def gps(self, fix: m.GpsFix, stamp_s: float, now_s: float) -> None:
        """Take a fix."""
        if self.vote.see_gps(fix, stamp_s, now_s):
            self.known = self.known or self.vote.compared
            self._hold_heading(fix, now_s)
            self._judge()

    def _hold_heading(self, fix: m.GpsFix, now_s: float) -> None:
        vote = self.vote
        if vote.track.straight and vote.wheels_fresh(now_s) and vote.position.fresh(now_s):
            course = math.atan2(fix.velocity_y_mps, fix.velocity_x_mps)
            off = min(abs(math.remainder(self._yaw_rad - heading, math.tau))
                      for heading in (course, vote.track.heading_rad))
            self._turned = self._turned + 1 if off > _TURNED_RAD else 0

    def _judge(self) -> None:
        vote = self.vote
        if vote.outlier == _POSE:
            self.reason = self.reason or (
                f"the pose is {vote.apart_m:.1f} m from GPS, which moves like the wheels")
        elif self._turned >= _TURNED_FIXES:
            self.reason = self.reason or "the heading differs from the IMU and the course"
        elif not self._turned:
            self.reason = ""


class EstimationError(DetectionModule):
    """Active while the published pose is wrong."""

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self.monitor = self.judged_by(EstimationMonitor(self.known_after_s(self.grace_s(1.0))))

    @on(topics.IMU)
    def imu(self, message: m.Imu, header: Header) -> None:
        """Take the heading."""
        self.monitor.vote.track.imu(message, header.stamp, self.clock.now())

    @on(topics.ODOMETRY)
    def odometry(self, message: m.Odometry, header: Header) -> None:
        """Take odometry."""
        self.monitor.vote.track.odometry(message, header.stamp, self.clock.now())

    @on(topics.BASE_STATUS)
    def status(self, message: m.BaseStatus, header: Header) -> None:
        """Take the wheel speeds."""
        self.monitor.vote.see_encoders(message, header.stamp, self.clock.now())

    @on(topics.GPS)
    def gps(self, message: m.GpsFix, header: Header) -> None:
        """Take a fix and compare."""
        self.monitor.gps(message, header.stamp, self.clock.now())
        self.follow()

    @on(topics.POSE)
    def pose(self, message: m.Pose, header: Header) -> None:
        """Take the checked pose."""
        self.monitor.pose(message, header.stamp, self.clock.now(),
                          f"{header.source}#{header.incarnation}")
        self.follow()
