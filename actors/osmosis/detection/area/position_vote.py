"""Two-out-of-three vote of a position, GPS and dead reckoning.

DM1 (voted) and DM8 have the same problem as localization. They solve it with other code, since a
check must not share the errors of what it checks.

Wheels and IMU give a *track*: the position if the robot had started at (0, 0). Each position source
has an offset from the track. Offsets of different times can be compared, since they do not depend
on the motion in between. The offset of a healthy source is constant. Its recent movement, with
forgetting, is the source's *deviation*, over some seconds and, for slow drifts, over a minute.

    both positions agree            they are correct, unless odometry, encoders and gyro agree on
                                    another motion: two against two
    they differ                     the one with a much larger deviation is wrong
    one is missing                  the other one counts while its deviation is small
    both are missing, or unclear    no position is trusted

Times are simulated seconds, positions are in `map`.
"""

from __future__ import annotations

import math

from rampart.actors.bus.envelope import AHEAD_S
from rampart.actors.ftm.plausible import is_possible, is_sane
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis.motion_check import MotionParity
from rampart.actors.osmosis.readings import is_fix, is_odometry

GPS = "GPS"
WHEELS = "dead reckoning"

Place = tuple[float, float]

# Limits of agreement; docs/case-study/localization.md explains the numbers.
APART_M = 0.3
"""Greatest distance of two positions that agree."""

DEVIATION_M = 0.35
"""Greatest deviation of a position that agrees with the wheels."""

CLEARLY = 2.0
"""Least ratio of the deviations that identifies the wrong one."""

FORGET_S = 5.0
"""Time constant of the deviation."""

STRAY_M, STRAY_S = 0.4, 60.0
"""Deviation over a minute, in which a drift of 1.5 cm/s moves a position by half a metre."""

POSITION_FRESH_S = 0.25
"""Greatest age of the other position."""

GPS_FRESH_S = 0.35
"""Greatest age of a fix."""

WHEELS_FRESH_S = 0.2
"""Greatest age of odometry, and of the IMU's heading."""

DIFFERING = 2
"""Consecutive fixes that must differ."""

AGREEING = 4
"""Consecutive fixes that must agree before a wrong source is trusted again."""


class Track:
    """Dead reckoning by wheels and IMU; the IMU's heading is aligned with the course of GPS.

    Attributes:
        place: position if the robot had started at (0, 0).
        stamp_s: time of the newest odometry.
        speed_mps: speed of the newest odometry.
        parity: whether odometry, encoders and gyro agree.
        aligned: whether its heading is that in `map`. The gyro starts aligned, and drifts; a module
            that joins a running system has to wait for a course.
    """

    def __init__(self, fresh_s: float, *, aligned: bool = True) -> None:
        self.aligned = aligned
        self.place: Place = (0.0, 0.0)
        self.stamp_s = -math.inf
        self.speed_mps = 0.0
        self._fresh_s = fresh_s
        self._align_rad = 0.0
        self._wheels_rad = 0.0
        self.parity = MotionParity()
        self._by_gyro = True
        # Offset from the wheels' heading to `map`, used without a gyro; None before the first.
        self._fallback_rad: float | None = None

    def imu(self, imu: m.Imu, stamp_s: float, now_s: float) -> None:
        """Take the IMU's heading."""
        self.parity.imu(imu, stamp_s, now_s)

    @property
    def by_gyro(self) -> bool:
        """Whether the heading is the gyro's: it is present and turns like the wheels."""
        return self._by_gyro and self.stamp_s - self.parity.gyro.stamp_s <= self._fresh_s

    @property
    def heading_rad(self) -> float:
        """Heading in `map`."""
        if self.by_gyro:
            return self.parity.gyro.yaw_rad + self._align_rad
        return (self._fallback_rad or 0.0) + self._wheels_rad

    def odometry(self, odometry: m.Odometry, stamp_s: float, now_s: float) -> float:
        """Take odometry; return the distance since the last one, m."""
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
                self._align_rad = self.heading_rad - self.parity.gyro.yaw_rad
                self.aligned = False  # by the wheels, which slip in a turn on the spot
            self._by_gyro = self.parity.gyro_agrees
        if dt_s > self._fresh_s:
            self.speed_mps = linear_mps
            return 0.0
        heading = self.heading_rad
        if self.by_gyro:  # slowly, so that a failing gyro is detected first
            off = heading - yaw_rad
            self._fallback_rad = off if self._fallback_rad is None else self._fallback_rad + (
                dt_s / _FALLBACK_S * math.remainder(off - self._fallback_rad, math.tau))
        made_m = (self.speed_mps + linear_mps) / 2 * dt_s
        self.speed_mps = linear_mps
        self.place = (self.place[0] + made_m * math.cos(heading),
                      self.place[1] + made_m * math.sin(heading))
        return abs(made_m)

    def align(self, course_rad: float) -> None:
        """Align with the course over ground while the robot drives straight ahead."""
        off = math.remainder(course_rad - self.heading_rad, math.tau)
        if not self.aligned:
            self._turn(off)
            self.aligned = True
        elif abs(off) < _WILD_COURSE_RAD:
            self._turn(_ALIGN_GAIN * off)

    def align_slowly(self, yaw_rad: float) -> None:
        """Align with the heading of a position source, no faster than a healthy gyro drifts."""
        off = math.remainder(yaw_rad - self.heading_rad, math.tau)
        self._turn(_SLOW_GAIN * max(-_SLOW_RAD, min(_SLOW_RAD, off)))

    def _turn(self, by_rad: float) -> None:
        if self.by_gyro:
            self._align_rad += by_rad
        else:
            self._fallback_rad = (self._fallback_rad or 0.0) + by_rad

    @property
    def straight(self) -> bool:
        """Whether the robot drives straight ahead, so that its course is its heading."""
        turns_radps = abs(self.parity.gyro.rate_radps)
        return self.speed_mps > _COURSE_FROM_MPS and turns_radps < _STRAIGHT_RADPS

    def at(self, stamp_s: float) -> Place:
        """Return the position at a time near the newest odometry."""
        on_m = self.speed_mps * max(-self._fresh_s, min(self._fresh_s, stamp_s - self.stamp_s))
        heading = self.heading_rad
        return (self.place[0] + on_m * math.cos(heading), self.place[1] + on_m * math.sin(heading))


_ALIGN_GAIN, _WILD_COURSE_RAD, _FALLBACK_S = 0.02, 0.3, 2.0
_SLOW_GAIN, _SLOW_RAD = 0.005, 0.01
"""20 times a second 1 mrad/s at most: four times the drift of the simulated gyro."""
_COURSE_FROM_MPS, _STRAIGHT_RADPS = 0.4, 0.1
_ALONE_S = 1.0
"""Without GPS for so long, a module that joins takes the heading of the other position."""


class Witness:
    """A source of positions and its deviation from the track.

    Attributes:
        stamp_s: time of the newest reading.
        offset: from the track to the newest reading.
    """

    def __init__(self, name: str, fresh_s: float) -> None:
        self.name = name
        self.stamp_s = -math.inf
        self.offset: Place = (0.0, 0.0)
        self._fresh_s = fresh_s
        self._usual: Place | None = None
        self._of_old: Place = (0.0, 0.0)

    def fresh(self, now_s: float) -> bool:
        """Whether its newest reading is fresh."""
        return now_s - self.stamp_s <= self._fresh_s

    def see(self, stamp_s: float, place: Place, track: Track, forget_s: float) -> None:
        """Take a reading; `forget_s` is infinite to freeze the averages."""
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
        """Restart the averages at the present offset."""
        self._usual = self._of_old = self.offset

    @property
    def deviation_m(self) -> float:
        """Recent deviation from the track."""
        return 0.0 if self._usual is None else math.dist(self.offset, self._usual)

    @property
    def strays(self) -> bool:
        """Whether it deviates from the track by more than the track's errors explain."""
        return self._usual is not None and (
            self.deviation_m > DEVIATION_M or math.dist(self.offset, self._of_old) > STRAY_M)


def _towards(here: Place, there: Place, share: float) -> Place:
    return (here[0] + share * (there[0] - here[0]), here[1] + share * (there[1] - here[1]))


class PositionVote:
    """The vote over time.

    Args:
        name: name of the position that is not GPS.
        aligned: whether the gyro's heading is that in `map`, as at the start of a system.

    Attributes:
        outlier: name of the outvoted position, or "".
        compared: whether both positions were ever compared.
        contradicted: whether odometry, encoders and gyro agree on another motion than both
            positions. Two against two: no position is trusted.
    """

    def __init__(self, name: str, *, aligned: bool = True) -> None:
        self.track = Track(WHEELS_FRESH_S, aligned=aligned)
        self._alone_since_s = math.inf
        self.position = Witness(name, POSITION_FRESH_S)
        self.gps = Witness(GPS, GPS_FRESH_S)
        self.outlier = ""
        self.compared = self.contradicted = False
        self.apart_m = 0.0
        self._differing = self._agreeing = 0

    # -- inputs ---------------------------------------------------------------------------------

    def see_position(self, stamp_s: float, place: Place, now_s: float,
                     yaw_rad: float | None = None) -> bool:
        """Take a reading of the position that is not GPS; return whether it is usable.

        Args:
            stamp_s: its time.
            place: position in `map`.
            now_s: now.
            yaw_rad: its heading, if that may align the gyro's while GPS is excluded.
        """
        if not self._usable(self.position, stamp_s, place, now_s):
            return False
        without_gps = self.outlier == GPS or not (self.outlier or self.gps.fresh(now_s))
        if yaw_rad is not None and without_gps:
            self._alone_since_s = min(self._alone_since_s, stamp_s)
            if self.track.aligned:
                self.track.align_slowly(yaw_rad)
            elif stamp_s - self._alone_since_s > _ALONE_S:
                self._align(yaw_rad)
        self.position.see(stamp_s, place, self.track, self._forget_s(self.position))
        return True

    def see_encoders(self, status: m.BaseStatus, stamp_s: float, now_s: float) -> None:
        """Take the wheel speeds."""
        self.track.parity.encoders(status, stamp_s, now_s)

    def see_gps(self, fix: m.GpsFix, stamp_s: float, now_s: float) -> bool:
        """Take a fix and compare; return whether it is usable."""
        if not is_fix(fix) or not self._usable(self.gps, stamp_s, (fix.x_m, fix.y_m), now_s):
            return False
        track = self.track
        self.gps.see(stamp_s, (fix.x_m, fix.y_m), track, self._forget_s(self.gps))
        if track.straight and self.outlier != GPS and not self.contradicted:
            self._align(math.atan2(fix.velocity_y_mps, fix.velocity_x_mps))
        if self.position.fresh(now_s):
            self._compare(now_s)
        else:
            self._differing = self._agreeing = 0
        return True

    def _align(self, course_rad: float) -> None:
        was_aligned = self.track.aligned
        self.track.align(course_rad)
        if not was_aligned:  # so far the track led elsewhere
            self.position.restart()
            self.gps.restart()

    def _usable(self, witness: Witness, stamp_s: float, place: Place, now_s: float) -> bool:
        return (stamp_s > witness.stamp_s and is_sane(*place)
                and -AHEAD_S <= now_s - stamp_s <= GPS_FRESH_S)

    def _forget_s(self, witness: Witness) -> float:
        """Return the time constant of a source's averages; infinite while they are frozen.

        They are frozen while it is open which source is wrong, then for that source, and for a
        source that deviates without another position to confirm it.
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
        """Compare two agreeing positions with confirmed dead reckoning."""
        parity, pair = self.track.parity, (self.position, self.gps)
        stray = all(witness.strays for witness in pair)
        if self.track.aligned and self.track.by_gyro and parity.confirmed(now_s):
            self.contradicted = stray
        elif not self.contradicted and not self.outlier and (
                stray or not (parity.whole(now_s) and parity.sure(now_s))):
            for witness in pair:
                witness.restart()

    def wheels_agree(self, now_s: float) -> bool:
        """Whether dead reckoning is possible and nothing contradicts it."""
        return (self.track.aligned and self.wheels_fresh(now_s)
                and self.track.parity.sure(now_s))

    def wheels_fresh(self, now_s: float) -> bool:
        """Whether odometry is received."""
        return now_s - self.track.stamp_s <= WHEELS_FRESH_S

    def agreeing(self, now_s: float) -> tuple[str, ...]:
        """Return the names of two witnesses that agree now, or none."""
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
