"""Where the robot is, from four sources of which any one may fail.

A Kalman filter alone does not isolate faults. It trusts a precise source that lies slowly, follows
it, and then rejects the honest one. So three witnesses of the position are held against each other,
absolute pose, GPS and dead reckoning (wheels and gyro), and two that agree outvote the third:

* *Both positions agree*: they are right, unless odometry, encoders and gyro agree with each other
  and not with them. If neither fits the filter, the prediction was wrong: the filter starts anew
  from them, and wheels or gyro are excluded.
* *Both positions agree, and odometry, encoders and gyro contradict them*: two against two. There
  is no estimate until both have moved as the wheels do for `proof_m`. The proof is still due after
  a restart.
* *They contradict each other*: the one that has moved otherwise than the wheels in the last seconds
  is excluded. If neither has done so clearly, both are excluded once they are far apart.
* *One fails the gate alone* (normalised innovation squared): it is not taken in, and if it goes on
  it is excluded.
* *The only one left* is excluded when it moves otherwise than the wheels: one against one.

What the wheels and the gyro say is checked before it is used (`motion_check`). An excluded source
is believed again when it has fitted for a second without a flaw.

While fewer than two witnesses agree the filter dead-reckons, and counts the way. Beyond `bridge_m`
it gives no estimate: not knowing is better than being wrong with confidence.

Times are simulated seconds, positions and headings are those of `base_link` in `map`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from rampart.actors.bus.envelope import AHEAD_S
from rampart.actors.osmosis.control.localization import position_source as positions
from rampart.actors.osmosis.control.localization.motion_check import ImuCheck, OdometryCheck
from rampart.actors.osmosis.control.localization.planar_ekf import PlanarEkf
from rampart.actors.osmosis.control.localization.position_source import FilterLimits, PositionSource
from rampart.actors.osmosis.control.polyline import wrap_angle
from rampart.actors.osmosis.messages import (
    BaseStatus,
    GpsFix,
    Imu,
    LocalizationStatus,
    Odometry,
    Pose,
)
from rampart.actors.osmosis.motion_parity import MotionParity
from rampart.actors.osmosis.readings import is_fix, is_pose

_MAX_AGE_S = 0.3
"""A reading that arrives later is not used: the robot has moved on."""


class Estimate(NamedTuple):
    """A pose in `map` and when it was true."""

    stamp_s: float
    pose: Pose


class PoseFilter:
    """Fuses the sources. Hand it each reading as it comes; ask for `estimate` when one is due.

    Args:
        limits: noise, gates and bounds.
        owed_m: see the attribute; of an earlier incarnation.

    Attributes:
        owed_m: way over which the positions still have to move as the wheels do before there is an
            estimate; 0 if they were not contradicted.
    """

    def __init__(self, limits: FilterLimits | None = None, owed_m: float = 0.0) -> None:
        self.limits = limits or FilterLimits()
        self.owed_m = owed_m
        self._parity = MotionParity()
        self._ekf: PlanarEkf | None = None
        self._wheels = OdometryCheck()
        self._gyro = ImuCheck()
        self._pose = PositionSource("absolute pose", fresh_s=0.2, patience=4)
        self._gps = PositionSource("GPS", fresh_s=0.35, patience=3)
        self._time_s = -math.inf
        self._speed_mps = 0.0
        self._track = (0.0, 0.0)
        self._apart = (0.0, 0.0)
        self._together = 0
        self._gyro_used: float | None = None
        self._gyro_off = 0.0
        self._first_s: float | None = None
        self._bridged_m = 0.0

    # -- results --------------------------------------------------------------------------------

    def estimate(self) -> Estimate | None:
        """Return the pose as of the newest accepted reading, or None while it is not known."""
        ekf = self._ekf
        if ekf is None or self._lost(ekf):
            return None
        return Estimate(self._time_s, Pose(ekf.x_m, ekf.y_m, ekf.yaw_rad))

    def status(self, now_s: float) -> LocalizationStatus:
        """Return which sources are in use, which not and why, and how sure the estimate is."""
        why_not = {source.name: source.why_not(now_s)
                   for source in (self._pose, self._gps, self._wheels, self._gyro)}
        ekf = self._ekf
        return LocalizationStatus(
            tuple(name for name, reason in why_not.items() if not reason),
            tuple((name, reason) for name, reason in why_not.items() if reason),
            ekf.position_sd_m if ekf else math.inf, ekf.heading_sd_rad if ekf else math.inf,
            self._bridged_m)

    def _lost(self, ekf: PlanarEkf) -> bool:
        blind = not self._wheels.usable(self._time_s) and not (
            self._pose.usable(self._time_s) or self._gps.usable(self._time_s))
        return (blind or self.owed_m > 0 or self._bridged_m > self.limits.bridge_m
                or ekf.position_sd_m > self.limits.largest_sd_m)

    # -- wheels and gyro ------------------------------------------------------------------------

    def imu(self, stamp_s: float, reading: Imu, now_s: float) -> None:
        """Take an IMU reading."""
        self._gyro.take(stamp_s, reading, now_s)
        self._parity.imu(reading, stamp_s, now_s)

    def encoders(self, stamp_s: float, reading: BaseStatus, now_s: float) -> None:
        """Take the base's own wheel speeds."""
        self._parity.encoders(reading, stamp_s, now_s)
        if not self._parity.encoders_agree(stamp_s):
            self._wheels.flaw("the encoders contradict it, or each other", stamp_s)

    def odometry(self, stamp_s: float, reading: Odometry, now_s: float) -> None:
        """Take an odometry reading."""
        if not _timely(stamp_s, now_s):
            return
        wheels = self._wheels
        self._parity.odometry(reading, stamp_s, now_s)
        step = wheels.take(stamp_s, reading)
        if step is None or self._ekf is None:
            return
        dt_s, forward_m, turn_rad = step
        if wheels.distrust:
            if abs(forward_m / dt_s - self._speed_mps) > _OTHER_SPEED_MPS:
                wheels.flaw(wheels.distrust, stamp_s)
            return
        self._speed_mps = reading.twist.linear_mps
        rest_s = stamp_s - self._time_s
        if rest_s <= 0:
            return
        if rest_s > dt_s + wheels.fresh_s:  # what was in between nobody has seen
            self._ekf.doubt(_TOP_SPEED_MPS * (rest_s - dt_s))
            self._bridged_m += _TOP_SPEED_MPS * (rest_s - dt_s)
        # After a while without wheels the filter may be part of the way along this step.
        share = rest_s / dt_s if rest_s < dt_s else 1.0
        self._move(self._ekf, stamp_s, forward_m * share, turn_rad * share)
        if self.owed_m and self._confirmed(stamp_s) and not any(
                source.strays or not source.usable(stamp_s) for source in (self._pose, self._gps)):
            self.owed_m = max(0.0, self.owed_m - abs(forward_m))

    def _move(self, ekf: PlanarEkf, stamp_s: float, forward_m: float, turn_rad: float | None
              ) -> None:
        """Predict up to a time; `turn_rad` by the wheels, None without them."""
        limits = self.limits
        dt_s = stamp_s - self._time_s
        wheels = turn_rad is not None
        if self._gyro.usable(stamp_s):
            heading = self._gyro.heading_at(stamp_s)
            before = self._gyro_used
            turn = turn_rad or 0.0 if before is None else wrap_angle(heading - before)
            self._gyro_used = heading
            turn_variance = _GYRO_RAD2_PER_S * dt_s
        else:
            self._gyro_used = None
            turn = turn_rad or 0.0
            turn_variance = ((_WHEEL_TURN_SHARE * turn) ** 2 + _WHEEL_RAD2_PER_S * dt_s if wheels
                             else (_UNKNOWN_TURN_RADPS * dt_s) ** 2)
        variance = limits.way_m2_per_m * abs(forward_m) + limits.way_m2_per_rad * abs(turn)
        if not wheels:
            variance += (_UNKNOWN_SPEED_MPS * dt_s) ** 2
        dx, dy = ekf.predict(forward_m, turn, variance, turn_variance)
        self._track = (self._track[0] + dx, self._track[1] + dy)
        self._time_s = stamp_s
        witnesses = (self._pose.usable(stamp_s) + self._gps.usable(stamp_s)
                     + (wheels or self._wheels.usable(stamp_s)))
        if witnesses >= 2:
            self._bridged_m = 0.0
        else:
            self._bridged_m += max(abs(forward_m), _CREEP_MPS * dt_s)
            pair = self._pose, self._gps
            if self._bridged_m > limits.bridge_m and all(
                    source.distrust and source.fresh(stamp_s) for source in pair):
                self.owed_m = limits.proof_m

    # -- positions ------------------------------------------------------------------------------

    def absolute_pose(self, stamp_s: float, pose: Pose, now_s: float) -> None:
        """Take an absolute pose."""
        source, (x_m, y_m, yaw_rad) = self._pose, (pose.x_m, pose.y_m, pose.yaw_rad)
        if not _timely(stamp_s, now_s) or not stamp_s > source.stamp_s \
                or not is_pose(pose):
            return
        then_s, was, limits, ekf = source.stamp_s, source.reading, self.limits, self._ekf
        source.stamp_s, source.reading = stamp_s, (x_m, y_m, yaw_rad)
        if ekf is None:
            self._try_to_start(now_s)
            return
        x_m, y_m = self._bring_up(ekf, source, stamp_s - then_s)
        yaw_rad += self._gyro.rate_radps * (self._time_s - stamp_s) if self._gyro.usable(
            stamp_s) else 0.0
        self._weigh_gyro(ekf, stamp_s)
        variance, heading_variance = limits.absolute_sd_m**2, limits.absolute_sd_rad**2
        if not self._parity.gyro_agrees and self._gyro.usable(stamp_s) \
                and ekf.heading_nis(yaw_rad, heading_variance) > limits.gate:
            self._gyro.flaw("turns otherwise than wheels and absolute pose", stamp_s)
            ekf.doubt(0.0, _GYRO_ASTRAY_RAD)
        fits = (ekf.position_nis(x_m, y_m, variance) <= limits.gate
                and ekf.heading_nis(yaw_rad, heading_variance) <= limits.gate)
        if self._judge(ekf, source, self._gps, fits):
            ekf.update_position(x_m, y_m, variance)
            ekf.update_heading(yaw_rad, heading_variance)
            dt_s = stamp_s - then_s
            if dt_s <= _MAX_AGE_S and not self._wheels.usable(stamp_s) \
                    and not self._gps.usable(stamp_s):
                made = source.reading[0] - was[0], source.reading[1] - was[1]
                self._speed_mps = (made[0] * math.cos(ekf.yaw_rad)
                                   + made[1] * math.sin(ekf.yaw_rad)) / dt_s

    def gps(self, stamp_s: float, fix: GpsFix, now_s: float) -> None:
        """Take a GPS fix."""
        source, x_m, y_m = self._gps, fix.x_m, fix.y_m
        velocity, accuracy_m = (fix.velocity_x_mps, fix.velocity_y_mps), fix.accuracy_m
        if not _timely(stamp_s, now_s) or not stamp_s > source.stamp_s or not is_fix(fix):
            return
        then_s, limits, ekf = source.stamp_s, self.limits, self._ekf
        same = (x_m, y_m, 0.0) == source.reading and velocity == source.velocity
        source.repeats = source.repeats + 1 if same else 0
        source.stamp_s, source.reading, source.velocity = stamp_s, (x_m, y_m, 0.0), velocity
        if ekf is None:
            self._try_to_start(now_s)
            return
        x_m, y_m = self._bring_up(ekf, source, stamp_s - then_s)
        if source.repeats >= _GPS_REPEATS:
            source.flaw("repeats the same fix", stamp_s)
        self._compare(ekf, stamp_s)
        variance = max(accuracy_m, limits.gps_sd_m) ** 2
        fits = source.repeats < _GPS_REPEATS and (
            ekf.position_nis(x_m, y_m, variance) <= limits.gate)
        if self._judge(ekf, source, self._pose, fits):
            ekf.update_position(x_m, y_m, variance)
            self._take_velocity(ekf, velocity, stamp_s)

    def _take_velocity(self, ekf: PlanarEkf, velocity: tuple[float, float], stamp_s: float) -> None:
        """Take the speed if the wheels are out, and the course if the absolute pose is."""
        along = velocity[0] * math.cos(ekf.yaw_rad) + velocity[1] * math.sin(ekf.yaw_rad)
        if not self._wheels.usable(stamp_s):
            self._speed_mps = along
        turning = abs(self._gyro.rate_radps) > _STRAIGHT_RADPS or not self._gyro.usable(stamp_s)
        if abs(along) < positions.COURSE_FROM_MPS or turning or self._pose.usable(stamp_s):
            return
        sign = math.copysign(1.0, along)
        course = math.atan2(sign * velocity[1], sign * velocity[0])
        variance = (positions.GPS_VELOCITY_SD_MPS / along) ** 2 + positions.SIDESLIP_RAD**2
        if ekf.heading_nis(course, variance) <= self.limits.gate:
            ekf.update_heading(course, variance)

    def _bring_up(self, ekf: PlanarEkf, source: PositionSource, dt_s: float) -> tuple[float, float]:
        """Move a reading on to the filter's time, note its offset from the track, return it.

        Without wheels the filter goes on with the last known speed up to the reading.
        """
        rest_s = source.stamp_s - self._time_s
        if rest_s > 0 and not self._wheels.usable(source.stamp_s):
            self._move(ekf, source.stamp_s, self._speed_mps * rest_s, None)
        on_m = self._speed_mps * (self._time_s - source.stamp_s)
        x_m = source.reading[0] + on_m * math.cos(ekf.yaw_rad)
        y_m = source.reading[1] + on_m * math.sin(ekf.yaw_rad)
        # While it is not clear who is wrong, and later of who is, nothing is taken for usual.
        sure = self._pose.distrust or self._gps.distrust
        doubted = source.distrust if sure else (math.hypot(*self._apart) > self.limits.apart_m)
        source.see((x_m - self._track[0], y_m - self._track[1]), dt_s, self.limits,
                   doubted=bool(doubted))
        return x_m, y_m

    # -- who is wrong ---------------------------------------------------------------------------

    def _compare(self, ekf: PlanarEkf, stamp_s: float) -> None:
        """Hold the absolute pose and GPS against each other, and both against the wheels."""
        pose, gps, limits = self._pose, self._gps, self.limits
        if not pose.fresh(stamp_s):
            self._apart, self._together = (0.0, 0.0), 0
            return
        together = math.dist(pose.offset, gps.offset) <= limits.apart_m and not gps.repeats
        self._together = self._together + 1 if together else 0
        apart = self._apart
        apart = self._apart = (
            apart[0] + _APART_GAIN * (pose.offset[0] - gps.offset[0] - apart[0]),
            apart[1] + _APART_GAIN * (pose.offset[1] - gps.offset[1] - apart[1]))
        apart_m = math.hypot(*apart)
        by_pose, by_gps = pose.deviation_m, gps.deviation_m
        excluded = pose.distrust or gps.distrust
        if apart_m <= limits.apart_m:
            if excluded:
                return
            stray = pose.strays and gps.strays
            if stray and self._confirmed(stamp_s):
                self._contradict(stamp_s)
            elif stray or self._wheels.distrust:
                if not self._wheels.distrust:
                    self._wheels.flaw("drifts against both positions", stamp_s)
                pose.start_over()
                gps.start_over()
            return
        if excluded:
            return
        clear = self._wheels.usable(stamp_s)
        if clear and by_pose > _CLEARLY * by_gps:
            self._exclude(ekf, pose, apart_m, stamp_s)
        elif clear and by_gps > _CLEARLY * by_pose:
            self._exclude(ekf, gps, apart_m, stamp_s)
        elif apart_m > limits.contradiction_m:
            for source, other in ((pose, gps), (gps, pose)):
                source.flaw(f"contradicts {other.name} by {apart_m:.1f} m", stamp_s)

    def _confirmed(self, stamp_s: float) -> bool:
        """Whether odometry, encoders and gyro are all there, and agree."""
        parity = self._parity
        return (parity.confirmed(stamp_s) and parity.gyro_agrees
                and self._wheels.usable(stamp_s) and self._gyro.usable(stamp_s))

    def _contradict(self, stamp_s: float) -> None:
        """Exclude both positions, which agree: odometry, encoders and gyro agree otherwise."""
        self.owed_m = self.limits.proof_m
        for source in (self._pose, self._gps):
            source.flaw("moves otherwise than odometry, encoders and gyro", stamp_s)

    def _exclude(self, ekf: PlanarEkf, source: PositionSource, apart_m: float, stamp_s: float
                 ) -> None:
        source.flaw(f"moves otherwise than the others, {apart_m:.1f} m", stamp_s)
        # It has been taken in until now; what was farther off than this failed the gate.
        doubt_m = min(apart_m, self.limits.contradiction_m / 2)
        ekf.doubt(doubt_m, doubt_m / 10)

    def _judge(self, ekf: PlanarEkf, source: PositionSource, other: PositionSource, fits: bool
               ) -> bool:
        """Note whether a reading fits; return whether to take it in."""
        stamp_s = source.stamp_s
        apart_m = math.hypot(*self._apart)
        if source.strays and not source.distrust \
                and not other.usable(stamp_s) \
                and self._wheels.usable(stamp_s) and self._gyro.usable(stamp_s):
            # One against one. Who is wrong is not known; dead reckoning is wrong more slowly.
            self._exclude(ekf, source, source.deviation_m, stamp_s)
        if fits:
            source.fails = 0
            if source.distrust:
                if (source.strays and (self.owed_m or (
                        other.strays and self._confirmed(stamp_s)))) or (
                        apart_m > self.limits.apart_m if other.fresh(stamp_s) else source.strays):
                    source.flaw(source.distrust, stamp_s)
                else:
                    source.clean(stamp_s)
                    if not source.distrust:
                        source.start_over()
            return not source.distrust
        source.fails += 1
        if source.distrust:
            source.flaw(source.distrust, stamp_s)
        if other.fails and other.fresh(stamp_s) and self._together >= _MORE_THAN_CHANCE:
            if not self._confirmed(stamp_s):
                self._believe_both(ekf, stamp_s)
            elif not source.distrust:
                self._contradict(stamp_s)
        elif source.fails >= source.patience and not source.distrust:
            source.flaw("does not fit the motion", stamp_s)
        return False

    def _believe_both(self, ekf: PlanarEkf, stamp_s: float) -> None:
        """Neither position fits the filter, and they agree: it was the prediction that failed."""
        pose, gps = self._pose, self._gps
        if abs(wrap_angle(pose.reading[2] - ekf.yaw_rad)) > _GYRO_ASTRAY_RAD:
            self._gyro.flaw("its turns do not fit the positions", stamp_s)
            self._gyro_used = None
        else:
            self._wheels.flaw("does not fit the positions", stamp_s)
        x_m, y_m = (o + t for o, t in zip(pose.offset, self._track, strict=True))
        ekf.doubt(1.0, 1.0)
        ekf.update_position(x_m, y_m, self.limits.absolute_sd_m**2)
        ekf.update_heading(pose.reading[2], self.limits.absolute_sd_rad**2)
        self._apart = (0.0, 0.0)
        for source in (pose, gps):
            source.distrust, source.fails = "", 0
            source.start_over()

    def _weigh_gyro(self, ekf: PlanarEkf, stamp_s: float) -> None:
        """Keep an excluded gyro excluded while it turns otherwise than the robot."""
        gyro = self._gyro
        if gyro.distrust:
            off = wrap_angle(gyro.yaw_rad - ekf.yaw_rad)
            if abs(wrap_angle(off - self._gyro_off)) > _GYRO_ASTRAY_RAD:
                self._gyro_off = off
                gyro.flaw(gyro.distrust, stamp_s)

    # -- start ----------------------------------------------------------------------------------

    def _try_to_start(self, now_s: float) -> None:
        pose, gps, limits = self._pose, self._gps, self.limits
        self._first_s = now_s if self._first_s is None else self._first_s
        first = positions.find_first(pose, gps, self._wheels, self._gyro, now_s=now_s,
                           waited_s=now_s - self._first_s)
        if first is None:
            return
        by_pose = first.source is pose
        self._time_s = first.source.stamp_s
        self._ekf = PlanarEkf(
            *first.source.reading[:2], first.yaw_rad,
            limits.absolute_sd_m if by_pose else limits.gps_sd_m,
            limits.absolute_sd_rad if first.heading_sd_rad is None else first.heading_sd_rad)
        self._speed_mps = (gps.velocity[0] * math.cos(first.yaw_rad)
                           + gps.velocity[1] * math.sin(first.yaw_rad))
        for source in (pose, gps):
            source.usual, source.offset = None, source.reading[:2]


_OTHER_SPEED_MPS = 0.3
_GYRO_RAD2_PER_S = 1e-6
_WHEEL_TURN_SHARE, _WHEEL_RAD2_PER_S = 0.15, 1e-5
_UNKNOWN_TURN_RADPS, _UNKNOWN_SPEED_MPS = 1.0, 0.3
_CREEP_MPS, _TOP_SPEED_MPS = 0.05, 1.0
_GPS_REPEATS, _STRAIGHT_RADPS = 2, 0.1
_APART_GAIN, _CLEARLY, _MORE_THAN_CHANCE = 0.3, 2.0, 3
_GYRO_ASTRAY_RAD = 0.1


def _timely(stamp_s: float, now_s: float) -> bool:
    return -AHEAD_S <= now_s - stamp_s <= _MAX_AGE_S
