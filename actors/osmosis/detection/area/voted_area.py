"""DM1 of the full system: the prohibited area, by a position on which two of three agree.

The paper's DM1 (`prohibited_area`) uses GPS alone: an error of two metres stops a healthy robot,
and a stuck receiver blinds it. This module votes between GPS, absolute pose and its own dead
reckoning. It is still independent of the localization node. While fewer than two agree, it uses
dead reckoning with an error bound that grows with the distance. Beyond a bounded time or distance
the position is unknown, and the module is active.
"""

from __future__ import annotations

import math

from rampart.actors.detection.module import DetectionModule
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.detection.area.position_vote import GPS, PositionVote
from rampart.actors.osmosis.detection.area.prohibited_area import GPS_PERIOD_S, fence_of
from rampart.actors.osmosis.readings import is_pose
from rampart.actors.runtime.actor import Context, Header, on
from rampart.manager.spec.tables import NonNegative, Positive

_ABSOLUTE = "absolute pose"
_ERROR_PER_M = 0.06
"""Error of dead reckoning, m per m: more than the largest measured over 5 m."""


class VotedPosition:
    """The voted position over time; `look` returns it as a fix.

    Args:
        accuracy_m: error bound of a voted position, m.
        blind_s: longest time on dead reckoning, s.
        blind_m: longest distance on dead reckoning, m.
        aligned: as for `PositionVote`.
    """

    def __init__(self, accuracy_m: float, blind_s: float, blind_m: float, *,
                 aligned: bool = True) -> None:
        self.vote = PositionVote(_ABSOLUTE, aligned=aligned)
        self._accuracy_m = accuracy_m
        self._blind_s, self._blind_m = blind_s, blind_m
        self._anchor: tuple[float, float] | None = None
        self._trusted_s = -math.inf
        self._since_m = 0.0
        self._fix: m.GpsFix | None = None
        self.by_gps = False

    def odometry(self, odometry: m.Odometry, stamp_s: float, now_s: float) -> None:
        """Take odometry."""
        self._since_m += self.vote.track.odometry(odometry, stamp_s, now_s)

    def gps(self, fix: m.GpsFix, stamp_s: float, now_s: float) -> None:
        """Take a GPS fix."""
        if self.vote.see_gps(fix, stamp_s, now_s):
            self._fix = fix

    def look(self, now_s: float) -> tuple[m.GpsFix, float] | None:
        """Return the position as a fix and its time; None if it is unknown."""
        vote = self.vote
        two = vote.agreeing(now_s)
        self.by_gps = GPS in two
        if two:
            witness = vote.gps if self.by_gps else vote.position
            self._anchor, self._since_m = witness.offset, 0.0
            self._trusted_s = witness.stamp_s
            if self.by_gps and self._fix is not None:
                return self._fix, witness.stamp_s
        if self._anchor is None or vote.contradicted or not vote.wheels_agree(now_s) \
                or now_s - self._trusted_s > self._blind_s or self._since_m > self._blind_m:
            return None
        track = vote.track
        heading = track.heading_rad
        return m.GpsFix(self._anchor[0] + track.place[0], self._anchor[1] + track.place[1],
                   track.speed_mps * math.cos(heading), track.speed_mps * math.sin(heading),
                   self._accuracy_m + _ERROR_PER_M * self._since_m), track.stamp_s


class VotedArea(DetectionModule):
    """Active while the robot would not stop before the prohibited area, or is not located."""

    class Parameters(DetectionModule.Parameters, frozen=True):
        """Thresholds.

        Attributes:
            margin_m: see `ProhibitedArea.Parameters`.
            unknown_s: longest time without a known position, s.
            blind_s: longest time on dead reckoning while fewer than two witnesses agree, s.
            blind_m: longest distance on dead reckoning, m.
        """

        margin_m: Positive | None = None
        unknown_s: NonNegative = 5 * GPS_PERIOD_S
        blind_s: NonNegative = 10.0
        blind_m: NonNegative = 5.0

    parameters: Parameters

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        parameters = self.parameters
        self._looked_s = -math.inf
        self._where = VotedPosition(
            context.run.system.robot.gps_accuracy_m, parameters.blind_s, parameters.blind_m,
            aligned=self.first_life)
        self.monitor = self.judged_by(fence_of(
            self, parameters.margin_m, "position that two sources agree on", parameters.unknown_s))

    @on(topics.IMU)
    def imu(self, message: m.Imu, header: Header) -> None:
        """Take the heading."""
        self._where.vote.track.imu(message, header.stamp, self.clock.now())

    @on(topics.ABSOLUTE_POSE)
    def absolute_pose(self, message: m.Pose, header: Header) -> None:
        """Take the absolute pose."""
        if is_pose(message):
            self._where.vote.see_position(header.stamp, (message.x_m, message.y_m),
                                          self.clock.now(), message.yaw_rad)

    @on(topics.BASE_STATUS)
    def status(self, message: m.BaseStatus, header: Header) -> None:
        """Take the wheel speeds."""
        self._where.vote.see_encoders(message, header.stamp, self.clock.now())

    @on(topics.GPS)
    def gps(self, message: m.GpsFix, header: Header) -> None:
        """Take a fix, and check position and velocity."""
        self._where.gps(message, header.stamp, self.clock.now())
        self._look()

    @on(topics.ODOMETRY)
    def odometry(self, message: m.Odometry, header: Header) -> None:
        """Take odometry, and check without GPS."""
        now_s = self.clock.now()
        self._where.odometry(message, header.stamp, now_s)
        waited_s = now_s - self._looked_s
        if waited_s >= (1.5 if self._where.by_gps else 0.99) * GPS_PERIOD_S:
            self._look()

    def _look(self) -> None:
        now_s = self._looked_s = self.clock.now()
        found = self._where.look(now_s)
        if found is not None:
            self.monitor.fix(*found, now_s)
        self.follow()
