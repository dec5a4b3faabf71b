"""Two out of three: a position, GPS, and the robot's own dead reckoning.

DM1 (voted) and DM8 have the same problem as localization, and solve it for themselves, by another
code than localization's: whoever checks must not share the error of what it checks.

Wheels and IMU give a *track*: where the robot would be if it had started at (0, 0). Each position
source has an offset from it. What the sources say at different times is compared by the offsets,
so motion between the readings does not matter, and the offset of an honest source stays while
that of a wrong one moves. Its recent movement, with forgetting, is its *deviation*.

    both positions agree            they are right, whatever the wheels say
    they differ                     the one with by far the greater deviation is wrong
    one is missing                  the other counts while its deviation is small
    neither, or nothing is clear    nobody is believed

Times are simulated seconds, positions are in `map`.
"""

from __future__ import annotations

import math

from rampart.actors.bus.envelope import AHEAD_S
from rampart.actors.ftm.plausible import is_possible, is_sane
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis.readings import is_fix, is_imu, is_odometry

GPS = "GPS"
WHEELS = "dead reckoning"

Place = tuple[float, float]

# When witnesses agree; docs/localization.md says where the numbers come from.
APART_M = 0.3
"""Two positions farther apart than this differ."""

DEVIATION_M = 0.35
"""A position that has moved otherwise than the wheels by more differs from them."""

CLEARLY = 2.0
"""How many times greater the deviation of the wrong one must be."""

FORGET_S = 5.0
"""Time constant of the deviation."""

POSITION_FRESH_S = 0.25
"""Greatest age of the other position."""

GPS_FRESH_S = 0.35
"""Greatest age of a fix."""

WHEELS_FRESH_S = 0.2
"""Greatest age of odometry, and of the IMU's heading."""

DIFFERING = 2
"""Fixes in a row that must differ before it counts."""

AGREEING = 4
"""Fixes in a row that must agree before who was wrong is believed again."""


class Track:
    """Dead reckoning by wheels and IMU; the IMU's heading is aligned with the course of GPS.

    Attributes:
        place: where the robot would be if it had started at (0, 0).
        stamp_s: of the newest odometry.
        speed_mps: of the newest odometry.
    """

    def __init__(self, fresh_s: float) -> None:
        self.place: Place = (0.0, 0.0)
        self.stamp_s = -math.inf
        self.speed_mps = 0.0
        self._fresh_s = fresh_s
        self._imu: tuple[float, float, float] = (-math.inf, 0.0, 0.0)
        self._align_rad = 0.0
        self._wheels_rad = 0.0
        self._fallback_rad = 0.0  # from the wheels' heading to that in `map`, for want of an IMU

    def imu(self, imu: m.Imu, stamp_s: float, now_s: float) -> None:
        """Take the IMU's heading."""
        if stamp_s > self._imu[0] and is_possible(stamp_s, now_s) and is_imu(imu):
            self._imu = (stamp_s, imu.yaw_rad, imu.yaw_rate_radps)

    @property
    def heading_rad(self) -> float:
        """Heading in `map`."""
        stamp_s, yaw_rad, _ = self._imu
        if self.stamp_s - stamp_s <= self._fresh_s:
            return yaw_rad + self._align_rad
        return self._fallback_rad + self._wheels_rad

    def odometry(self, odometry: m.Odometry, stamp_s: float, now_s: float) -> float:
        """Take odometry; return the way made since the last, m."""
        yaw_rad, linear_mps = odometry.pose.yaw_rad, odometry.twist.linear_mps
        if not stamp_s > self.stamp_s or not is_possible(stamp_s, now_s) \
                or not is_odometry(odometry):
            return 0.0
        dt_s = stamp_s - self.stamp_s
        self.stamp_s = stamp_s
        self._wheels_rad = yaw_rad
        if dt_s > self._fresh_s:
            self.speed_mps = linear_mps
            return 0.0
        heading = self.heading_rad
        if stamp_s - self._imu[0] <= self._fresh_s:
            self._fallback_rad = heading - yaw_rad
        made_m = (self.speed_mps + linear_mps) / 2 * dt_s
        self.speed_mps = linear_mps
        self.place = (self.place[0] + made_m * math.cos(heading),
                      self.place[1] + made_m * math.sin(heading))
        return abs(made_m)

    def align(self, course_rad: float) -> None:
        """Take the course over ground of a robot that drives straight forward."""
        off = math.remainder(course_rad - self.heading_rad, math.tau)
        if abs(off) >= _WILD_COURSE_RAD:
            return
        if self.stamp_s - self._imu[0] <= self._fresh_s:
            self._align_rad += _ALIGN_GAIN * off
        else:
            self._fallback_rad += _ALIGN_GAIN * off

    @property
    def straight(self) -> bool:
        """Whether the robot drives straight on, so that its course is its heading."""
        return self.speed_mps > _COURSE_FROM_MPS and abs(self._imu[2]) < _STRAIGHT_RADPS

    def at(self, stamp_s: float) -> Place:
        """Return the place at a time near the newest odometry."""
        on_m = self.speed_mps * max(-self._fresh_s, min(self._fresh_s, stamp_s - self.stamp_s))
        heading = self.heading_rad
        return (self.place[0] + on_m * math.cos(heading), self.place[1] + on_m * math.sin(heading))


_ALIGN_GAIN, _WILD_COURSE_RAD = 0.02, 0.3
_COURSE_FROM_MPS, _STRAIGHT_RADPS = 0.4, 0.1


class Witness:
    """One source of positions, held against the track.

    Attributes:
        stamp_s: of the newest reading.
        offset: of the newest reading from the track.
    """

    def __init__(self, name: str, fresh_s: float) -> None:
        self.name = name
        self.stamp_s = -math.inf
        self.offset: Place = (0.0, 0.0)
        self._fresh_s = fresh_s
        self._usual: Place | None = None

    def fresh(self, now_s: float) -> bool:
        """Whether its newest reading is new enough."""
        return now_s - self.stamp_s <= self._fresh_s

    def see(self, stamp_s: float, place: Place, track: Track, forget_s: float) -> None:
        """Take a reading; `forget_s` is infinite while it is not to be taken for usual."""
        at = track.at(stamp_s)
        offset = self.offset = (place[0] - at[0], place[1] - at[1])
        dt_s, self.stamp_s = stamp_s - self.stamp_s, stamp_s
        usual = self._usual
        if usual is None or (dt_s > 1.0 and forget_s < math.inf):
            self._usual = offset
        elif forget_s < math.inf:
            gain = dt_s / forget_s
            self._usual = (usual[0] + gain * (offset[0] - usual[0]),
                           usual[1] + gain * (offset[1] - usual[1]))

    def restart(self) -> None:
        """Take the present offset for usual."""
        self._usual = self.offset

    @property
    def deviation_m(self) -> float:
        """By how much it has lately moved otherwise than the track."""
        return 0.0 if self._usual is None else math.dist(self.offset, self._usual)


class PositionVote:
    """The vote over time.

    Args:
        name: of the position that is not GPS.

    Attributes:
        outlier: name of the position that is outvoted; "" if none is.
        compared: whether both positions were ever held against each other.
    """

    def __init__(self, name: str) -> None:
        self.track = Track(WHEELS_FRESH_S)
        self.position = Witness(name, POSITION_FRESH_S)
        self.gps = Witness(GPS, GPS_FRESH_S)
        self.outlier = ""
        self.compared = False
        self.apart_m = 0.0
        self._differing = self._agreeing = 0

    # -- what is heard --------------------------------------------------------------------------

    def see_position(self, stamp_s: float, place: Place, now_s: float) -> bool:
        """Take a reading of the position that is not GPS; return whether it could be used."""
        if not self._usable(self.position, stamp_s, place, now_s):
            return False
        self.position.see(stamp_s, place, self.track, self._forget_s(self.position))
        return True

    def see_gps(self, fix: m.GpsFix, stamp_s: float, now_s: float) -> bool:
        """Take a fix and compare; return whether it could be used."""
        if not is_fix(fix) or not self._usable(self.gps, stamp_s, (fix.x_m, fix.y_m), now_s):
            return False
        track = self.track
        self.gps.see(stamp_s, (fix.x_m, fix.y_m), track, self._forget_s(self.gps))
        if track.straight and self.outlier != GPS:
            track.align(math.atan2(fix.velocity_y_mps, fix.velocity_x_mps))
        if self.position.fresh(now_s):
            self._compare(now_s)
        else:
            self._differing = self._agreeing = 0
        return True

    def _usable(self, witness: Witness, stamp_s: float, place: Place, now_s: float) -> bool:
        return (stamp_s > witness.stamp_s and is_sane(*place)
                and -AHEAD_S <= now_s - stamp_s <= GPS_FRESH_S)

    def _forget_s(self, witness: Witness) -> float:
        """While it is not clear who is wrong, and later of who is, nothing is taken for usual.

        Nor of one that deviates while no other position confirms it: it would be forgotten.
        """
        if self.outlier == witness.name or (self._differing > 0 and not self.outlier):
            return math.inf
        alone = not self._agreeing and witness.deviation_m > DEVIATION_M
        return math.inf if alone else FORGET_S

    # -- judgement ------------------------------------------------------------------------------

    def _compare(self, now_s: float) -> None:
        position, gps = self.position, self.gps
        self.compared = True
        self.apart_m = math.dist(position.offset, gps.offset)
        if self.apart_m <= APART_M:
            self._differing = 0
            self._agreeing += 1
            if self.outlier and self._agreeing >= AGREEING:
                self.outlier = ""
                position.restart()
                gps.restart()
            return
        self._agreeing = 0
        self._differing += 1
        if self.outlier or self._differing < DIFFERING or not self.wheels_fresh(now_s):
            return
        for wrong, other in ((position, gps), (gps, position)):
            if wrong.deviation_m > CLEARLY * other.deviation_m \
                    and other.deviation_m <= DEVIATION_M:
                self.outlier = wrong.name
                other.restart()

    def wheels_fresh(self, now_s: float) -> bool:
        """Whether odometry is heard."""
        return now_s - self.track.stamp_s <= WHEELS_FRESH_S

    def agreeing(self, now_s: float) -> tuple[str, ...]:
        """Return the names of two witnesses that agree now; none if there are no two."""
        position, gps = self.position, self.gps
        sure = not self.outlier and not self._differing
        if sure and position.fresh(now_s) and gps.fresh(now_s):
            return (position.name, GPS)
        if not self.wheels_fresh(now_s):
            return ()
        for witness, other in ((gps, position), (position, gps)):
            alone = self.outlier == other.name or (sure and not other.fresh(now_s))
            if alone and witness.fresh(now_s) and witness.deviation_m <= DEVIATION_M:
                return (witness.name, WHEELS)
        return ()
