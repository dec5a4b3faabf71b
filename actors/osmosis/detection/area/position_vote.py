"""Two out of three: a position, GPS, and the robot's own dead reckoning.

DM1 (voted) and DM8 have the same problem as localization, and solve it for themselves, by another
code than localization's: whoever checks must not share the error of what it checks.

Wheels and IMU give a *track*: where the robot would be if it had started at (0, 0). Each position
source has an offset from it. What the sources say at different times is compared by the offsets,
so motion between the readings does not matter, and the offset of an honest source stays while
that of a wrong one moves. Its recent movement, with forgetting, is its *deviation*,
over some seconds and over a minute: a slow drift leaves no trace in five seconds.

    both positions agree            they are right, unless both have moved otherwise than
                                    odometry, encoders and gyro, which agree: two against two
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
from rampart.actors.osmosis.motion_parity import MotionParity
from rampart.actors.osmosis.readings import is_fix, is_imu, is_odometry

GPS = "GPS"
WHEELS = "dead reckoning"

Place = tuple[float, float]

# When witnesses agree; docs/case-study/localization.md says where the numbers come from.
APART_M = 0.3
"""Two positions farther apart than this differ."""

DEVIATION_M = 0.35
"""A position that has moved otherwise than the wheels by more differs from them."""

CLEARLY = 2.0
"""How many times greater the deviation of the wrong one must be."""

FORGET_S = 5.0
"""Time constant of the deviation."""

STRAY_M, STRAY_S = 0.4, 60.0
"""The same over a minute: a drift of 1.5 cm/s has then moved a position by half a metre."""

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
        parity: whether odometry, encoders and gyro agree.
    """

    def __init__(self, fresh_s: float) -> None:
        self.place: Place = (0.0, 0.0)
        self.stamp_s = -math.inf
        self.speed_mps = 0.0
        self._fresh_s = fresh_s
        self._imu: tuple[float, float, float] = (-math.inf, 0.0, 0.0)
        self._align_rad = 0.0
        self._wheels_rad = 0.0
        self.parity = MotionParity()
        self._by_gyro = True
        # From the wheels' heading to that in `map`, for want of a gyro; None before the first.
        self._fallback_rad: float | None = None

    def imu(self, imu: m.Imu, stamp_s: float, now_s: float) -> None:
        """Take the IMU's heading."""
        if stamp_s > self._imu[0] and is_possible(stamp_s, now_s) and is_imu(imu):
            self._imu = (stamp_s, imu.yaw_rad, imu.yaw_rate_radps)
            self.parity.imu(imu, stamp_s, now_s)

    @property
    def by_gyro(self) -> bool:
        """Whether the heading is the gyro's: it is present, and turns as the wheels do."""
        return self._by_gyro and self.stamp_s - self._imu[0] <= self._fresh_s

    @property
    def heading_rad(self) -> float:
        """Heading in `map`."""
        if self.by_gyro:
            return self._imu[1] + self._align_rad
        return (self._fallback_rad or 0.0) + self._wheels_rad

    def odometry(self, odometry: m.Odometry, stamp_s: float, now_s: float) -> float:
        """Take odometry; return the way made since the last, m."""
        yaw_rad, linear_mps = odometry.pose.yaw_rad, odometry.twist.linear_mps
        if not stamp_s > self.stamp_s or not is_possible(stamp_s, now_s) \
                or not is_odometry(odometry):
            return 0.0
        self.parity.odometry(odometry, stamp_s, now_s)
        dt_s = stamp_s - self.stamp_s
        self.stamp_s = stamp_s
        self._wheels_rad = yaw_rad
        if self.parity.gyro_agrees is not self._by_gyro:
            if self.parity.gyro_agrees:
                self._align_rad = self.heading_rad - self._imu[1]
            self._by_gyro = self.parity.gyro_agrees
        if dt_s > self._fresh_s:
            self.speed_mps = linear_mps
            return 0.0
        heading = self.heading_rad
        if self.by_gyro:  # slowly: what a failing gyro adds is not taken over before it is noticed
            off = heading - yaw_rad
            self._fallback_rad = off if self._fallback_rad is None else self._fallback_rad + (
                dt_s / _FALLBACK_S * math.remainder(off - self._fallback_rad, math.tau))
        made_m = (self.speed_mps + linear_mps) / 2 * dt_s
        self.speed_mps = linear_mps
        self.place = (self.place[0] + made_m * math.cos(heading),
                      self.place[1] + made_m * math.sin(heading))
        return abs(made_m)

    def align(self, course_rad: float) -> None:
        """Take the course over ground of a robot that drives straight forward."""
        off = math.remainder(course_rad - self.heading_rad, math.tau)
        if abs(off) < _WILD_COURSE_RAD:
            self._turn(_ALIGN_GAIN * off)

    def align_slowly(self, yaw_rad: float) -> None:
        """Take the heading of a position source, no faster than a sound gyro drifts."""
        off = math.remainder(yaw_rad - self.heading_rad, math.tau)
        self._turn(_SLOW_GAIN * max(-_SLOW_RAD, min(_SLOW_RAD, off)))

    def _turn(self, by_rad: float) -> None:
        if self.by_gyro:
            self._align_rad += by_rad
        else:
            self._fallback_rad = (self._fallback_rad or 0.0) + by_rad

    @property
    def straight(self) -> bool:
        """Whether the robot drives straight on, so that its course is its heading."""
        return self.speed_mps > _COURSE_FROM_MPS and abs(self._imu[2]) < _STRAIGHT_RADPS

    def at(self, stamp_s: float) -> Place:
        """Return the place at a time near the newest odometry."""
        on_m = self.speed_mps * max(-self._fresh_s, min(self._fresh_s, stamp_s - self.stamp_s))
        heading = self.heading_rad
        return (self.place[0] + on_m * math.cos(heading), self.place[1] + on_m * math.sin(heading))


_ALIGN_GAIN, _WILD_COURSE_RAD, _FALLBACK_S = 0.02, 0.3, 2.0
_SLOW_GAIN, _SLOW_RAD = 0.005, 0.01
"""20 times a second 1 mrad/s at most: four times the drift of the simulated gyro."""
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
        self._of_old: Place = (0.0, 0.0)

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
            self.restart()
        elif forget_s < math.inf:
            self._usual = _towards(usual, offset, dt_s / forget_s)
            self._of_old = _towards(self._of_old, offset, dt_s / STRAY_S)

    def restart(self) -> None:
        """Take the present offset for usual."""
        self._usual = self._of_old = self.offset

    @property
    def deviation_m(self) -> float:
        """By how much it has lately moved otherwise than the track."""
        return 0.0 if self._usual is None else math.dist(self.offset, self._usual)

    @property
    def strays(self) -> bool:
        """Whether it has moved otherwise than the track by more than the track's errors explain."""
        return self._usual is not None and (
            self.deviation_m > DEVIATION_M or math.dist(self.offset, self._of_old) > STRAY_M)


def _towards(here: Place, there: Place, share: float) -> Place:
    return (here[0] + share * (there[0] - here[0]), here[1] + share * (there[1] - here[1]))


class PositionVote:
    """The vote over time.

    Args:
        name: of the position that is not GPS.

    Attributes:
        outlier: name of the position that is outvoted; "" if none is.
        compared: whether both positions were ever held against each other.
        contradicted: whether both positions have moved otherwise than wheels and gyro, although
            odometry, encoders and gyro agree. Two against two: no witness is believed.
    """

    def __init__(self, name: str) -> None:
        self.track = Track(WHEELS_FRESH_S)
        self.position = Witness(name, POSITION_FRESH_S)
        self.gps = Witness(GPS, GPS_FRESH_S)
        self.outlier = ""
        self.compared = self.contradicted = False
        self.apart_m = 0.0
        self._differing = self._agreeing = 0

    # -- what is heard --------------------------------------------------------------------------

    def see_position(self, stamp_s: float, place: Place, now_s: float,
                     yaw_rad: float | None = None) -> bool:
        """Take a reading of the position that is not GPS; return whether it could be used.

        Args:
            stamp_s: when it was true.
            place: in `map`.
            now_s: now.
            yaw_rad: its heading, if that may keep the gyro's aligned while GPS is out.
        """
        if not self._usable(self.position, stamp_s, place, now_s):
            return False
        without_gps = self.outlier == GPS or not (self.outlier or self.gps.fresh(now_s))
        if yaw_rad is not None and without_gps:
            self.track.align_slowly(yaw_rad)
        self.position.see(stamp_s, place, self.track, self._forget_s(self.position))
        return True

    def see_encoders(self, status: m.BaseStatus, stamp_s: float, now_s: float) -> None:
        """Take the base's own wheel speeds."""
        self.track.parity.encoders(status, stamp_s, now_s)

    def see_gps(self, fix: m.GpsFix, stamp_s: float, now_s: float) -> bool:
        """Take a fix and compare; return whether it could be used."""
        if not is_fix(fix) or not self._usable(self.gps, stamp_s, (fix.x_m, fix.y_m), now_s):
            return False
        track = self.track
        self.gps.see(stamp_s, (fix.x_m, fix.y_m), track, self._forget_s(self.gps))
        if track.straight and self.outlier != GPS and not self.contradicted:
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
        alone = not self._agreeing and witness.strays
        return math.inf if alone or self.contradicted else FORGET_S

    # -- judgement ------------------------------------------------------------------------------

    def _compare(self, now_s: float) -> None:
        position, gps = self.position, self.gps
        self.compared = True
        self.apart_m = math.dist(position.offset, gps.offset)
        if self.apart_m <= APART_M:
            self._differing = 0
            self._agreeing += 1
            self._hold_against_motion(now_s)
            if self.outlier and self._agreeing >= AGREEING and not self.contradicted:
                self.outlier = ""
                position.restart()
                gps.restart()
            return
        self._agreeing = 0
        self._differing += 1
        if self.outlier or self._differing < DIFFERING or not self.wheels_agree(now_s):
            return
        for wrong, other in ((position, gps), (gps, position)):
            if wrong.deviation_m > CLEARLY * other.deviation_m \
                    and other.deviation_m <= DEVIATION_M:
                self.outlier = wrong.name
                other.restart()

    def _hold_against_motion(self, now_s: float) -> None:
        """Compare two positions that agree with a dead reckoning that is confirmed."""
        parity, pair = self.track.parity, (self.position, self.gps)
        stray = all(witness.strays for witness in pair)
        if self.track.by_gyro and parity.confirmed(now_s):
            self.contradicted = stray
        elif not self.contradicted and not self.outlier and (
                stray or not (parity.whole(now_s) and parity.sure(now_s))):
            for witness in pair:
                witness.restart()

    def wheels_agree(self, now_s: float) -> bool:
        """Whether odometry is received and nothing contradicts it."""
        return self.wheels_fresh(now_s) and self.track.parity.sure(now_s)

    def wheels_fresh(self, now_s: float) -> bool:
        """Whether odometry is heard."""
        return now_s - self.track.stamp_s <= WHEELS_FRESH_S

    def agreeing(self, now_s: float) -> tuple[str, ...]:
        """Return the names of two witnesses that agree now; none if there are no two."""
        position, gps = self.position, self.gps
        if self.contradicted:
            return ()
        sure = not self.outlier and not self._differing
        if sure and position.fresh(now_s) and gps.fresh(now_s):
            return (position.name, GPS)
        if not self.wheels_agree(now_s):
            return ()
        for witness, other in ((gps, position), (position, gps)):
            alone = self.outlier == other.name or (sure and not other.fresh(now_s))
            if alone and witness.fresh(now_s) and not witness.strays:
                return (witness.name, WHEELS)
        return ()
