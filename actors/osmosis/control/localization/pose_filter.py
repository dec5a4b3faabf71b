"""Estimates the robot's pose from four sources, any one of which may fail.

A Kalman filter alone does not isolate faults: it follows a precise source that drifts slowly, and
then rejects the healthy one. So three witnesses of the position vote: absolute pose, GPS, and dead
reckoning (wheels and gyro). Two that agree outvote the third:

* *Both positions agree*: they are correct, unless odometry, encoders and gyro agree on another
  motion. If neither position fits the filter, the prediction was wrong: the filter restarts from
  them and excludes wheels or gyro.
* *Both positions agree, and odometry, encoders and gyro contradict them*: two against two. The
  filter gives no estimate until both positions have moved like the wheels for `proof_m`, also after
  a restart of the process.
* *The positions contradict each other*: the one that has deviated from the wheels in the last
  seconds is excluded. If neither clearly has, both are excluded once they are far apart.
* *One position alone fails the gate* (normalised innovation squared): the filter rejects the
  reading, and excludes the source if that persists.
* *A single remaining position* is excluded when it deviates from the wheels: one against one.

Wheels and gyro are checked before use (`motion_check`). An excluded source is used again after a
second without a flaw.

A position is compared with dead reckoning by its *offset*: from the track by wheels and gyro to the
reading. The offset of a healthy source is constant; its distance to its average of the last seconds
is the source's *deviation*.

While fewer than two witnesses agree, the filter dead-reckons and counts the distance. Beyond
`bridge_m` it gives no estimate: no pose is better than a wrong one.

Times are simulated seconds; poses are those of `base_link` in `map`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import msgspec

from rampart.actors.bus.envelope import AHEAD_S
from rampart.actors.osmosis.control.localization.planar_ekf import PlanarEkf
from rampart.actors.osmosis.control.polyline import wrap_angle
from rampart.actors.osmosis.messages import (
    BaseStatus,
    GpsFix,
    Imu,
    LocalizationStatus,
    Odometry,
    Pose,
)
from rampart.actors.osmosis.motion_check import ImuCheck, MotionParity, OdometryCheck, Source
from rampart.actors.osmosis.readings import is_fix, is_pose

_MAX_AGE_S = 0.3
"""Greatest age of a reading on arrival."""

_OTHER_SPEED_MPS = 0.3
_GYRO_RAD2_PER_S = 1e-6
_WHEEL_TURN_SHARE, _WHEEL_RAD2_PER_S = 0.15, 1e-5
_UNKNOWN_TURN_RADPS, _UNKNOWN_SPEED_MPS = 1.0, 0.3
_CREEP_MPS, _TOP_SPEED_MPS = 0.05, 1.0
_GPS_REPEATS, _STRAIGHT_RADPS = 2, 0.1
_APART_GAIN, _CLEARLY, _MORE_THAN_CHANCE = 0.3, 2.0, 3
_GYRO_ASTRAY_RAD = 0.1

GPS_VELOCITY_SD_MPS, SIDESLIP_RAD = 0.03, 0.03
COURSE_FROM_MPS = 0.4
"""Least speed at which the velocity over ground gives the heading."""

ASTRAY_M, STRAY_M = 0.25, 0.4
"""Largest distance of a position to its average of some seconds, and of a minute."""

_APART_M = 0.3
_ALONE_S = 0.15
_IMU_SD_RAD = 0.05
_TOO_LONG_S = 1.0
"""After a longer gap the averages restart."""


class FilterLimits(msgspec.Struct, frozen=True):
    """Noise, gates and bounds; docs/case-study/localization.md explains the numbers.

    Args:
        bridge_m: longest distance driven while fewer than two witnesses agree.
        largest_sd_m: largest standard deviation of the position for an estimate.
        absolute_sd_m: standard deviation of the absolute position.
        absolute_sd_rad: standard deviation of the absolute heading.
        gps_sd_m: least standard deviation of GPS; a receiver may report a larger one.
        gate: largest normalised innovation squared of a position or heading: 5 sigma.
        apart_m: largest mean distance between absolute pose and GPS while they agree.
        contradiction_m: distance at which both are excluded if neither is identified as wrong.
        way_m2_per_m: variance of dead reckoning per metre driven.
        way_m2_per_rad: the same per radian turned, since skid steering slips sideways.
        witness_s: time constant for the comparison of a position with dead reckoning.
        stray_s: the same for slow drifts.
        proof_m: distance that contradicted positions have to move like the wheels.
    """

    bridge_m: float = 10.0
    largest_sd_m: float = 0.5
    absolute_sd_m: float = 0.02
    absolute_sd_rad: float = 0.01
    gps_sd_m: float = 0.02
    gate: float = 25.0
    apart_m: float = 0.1
    contradiction_m: float = 0.4
    way_m2_per_m: float = 1e-4
    way_m2_per_rad: float = 2.5e-3
    witness_s: float = 5.0
    stray_s: float = 60.0
    proof_m: float = 20.0


@dataclass(slots=True)
class PositionSource(Source):
    """A source of positions.

    Attributes:
        patience: consecutive readings that fail the gate before the source is excluded.
        reading: newest reading: x m, y m, yaw rad.
        velocity: over ground in `map`, m/s, if the source measures it.
        offset: from the dead-reckoned track to the newest reading, m.
        usual: mean offset of the last seconds; None before the first reading.
        of_old: mean offset of a minute.
        fails: consecutive readings that failed the gate.
        repeats: consecutive readings that are bitwise equal.
    """

    patience: int
    reading: tuple[float, float, float] = (0.0, 0.0, 0.0)
    velocity: tuple[float, float] = (0.0, 0.0)
    offset: tuple[float, float] = (0.0, 0.0)
    usual: tuple[float, float] | None = None
    of_old: tuple[float, float] = (0.0, 0.0)
    fails: int = 0
    repeats: int = 0

    def see(self, offset: tuple[float, float], dt_s: float, limits: FilterLimits, *,
            doubted: bool) -> None:
        """Take an offset, `dt_s` after the last one; a doubted one is not averaged."""
        self.offset = offset
        usual = self.usual
        if usual is None or dt_s > _TOO_LONG_S:
            self.start_over()
        elif not doubted:
            self.usual = _towards(usual, offset, dt_s / limits.witness_s)
            self.of_old = _towards(self.of_old, offset, dt_s / limits.stray_s)

    def start_over(self) -> None:
        """Restart the averages at the present offset."""
        self.usual = self.of_old = self.offset

    @property
    def deviation_m(self) -> float:
        """Deviation from the wheels in the last seconds."""
        return 0.0 if self.usual is None else math.dist(self.offset, self.usual)

    @property
    def strays(self) -> bool:
        """Whether it deviates from the wheels by more than their errors explain."""
        return self.usual is not None and (
            self.deviation_m > ASTRAY_M or math.dist(self.offset, self.of_old) > STRAY_M)


def _towards(here: tuple[float, float], there: tuple[float, float], share: float
             ) -> tuple[float, float]:
    return (here[0] + share * (there[0] - here[0]), here[1] + share * (there[1] - here[1]))


class FirstPose(NamedTuple):
    """Start of the filter: the position's source, the heading, its standard deviation.

    `heading_sd_rad` None stands for that of the absolute pose.
    """

    source: PositionSource
    yaw_rad: float
    heading_sd_rad: float | None = None


def find_first(pose: PositionSource, gps: PositionSource, wheels: OdometryCheck, gyro: ImuCheck,
               *, now_s: float, waited_s: float) -> FirstPose | None:
    """Return the first pose; None while it is unknown.

    The filter starts from both positions if they agree, or after `_ALONE_S` from a single one.
    Without an absolute pose the heading is the IMU's, which was aligned before the mission, or else
    the course over ground of a robot that moves forward.

    Args:
        pose: the absolute pose.
        gps: GPS.
        wheels: gives the direction of motion.
        gyro: the IMU.
        now_s: now.
        waited_s: time since the first reading.
    """
    by_pose, by_gps = pose.fresh(now_s), gps.fresh(now_s)
    if by_pose and by_gps:
        dt_s = pose.stamp_s - gps.stamp_s
        there = [at + v * dt_s for at, v in zip(gps.reading, gps.velocity, strict=False)]
        return FirstPose(pose, pose.reading[2]) \
            if math.dist(there, pose.reading[:2]) <= _APART_M else None
    if not (by_pose or by_gps) or waited_s < _ALONE_S:
        return None
    if by_pose:
        return FirstPose(pose, pose.reading[2])
    if gyro.usable(now_s):
        return FirstPose(gps, wrap_angle(gyro.yaw_rad), _IMU_SD_RAD)
    vx, vy = gps.velocity
    speed_mps = math.hypot(vx, vy)
    if speed_mps > COURSE_FROM_MPS and wheels.speed_mps > 0:
        return FirstPose(gps, math.atan2(vy, vx), GPS_VELOCITY_SD_MPS / speed_mps + SIDESLIP_RAD)
    return None


class Estimate(NamedTuple):
    """A pose in `map` and its time."""

    stamp_s: float
    pose: Pose


class PoseFilter:
    """Fuses the sources: takes each reading on arrival, and gives an `estimate`.

    Args:
        limits: noise, gates and bounds.
        owed_m: value of the attribute from the previous incarnation.

    Attributes:
        owed_m: distance that the positions still have to move like the wheels before there is an
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
        """Return the pose at the newest accepted reading, or None while it is unknown."""
        ekf = self._ekf
        if ekf is None or self._lost(ekf):
            return None
        return Estimate(self._time_s, Pose(ekf.x_m, ekf.y_m, ekf.yaw_rad))

    def status(self, now_s: float) -> LocalizationStatus:
        """Return the sources in use, the excluded ones with reasons, and the uncertainty."""
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
        """Take the base's wheel speeds."""
        self._parity.encoders(reading, stamp_s, now_s)
        if not self._parity.encoders_agree(stamp_s):
            self._wheels.flaw("contradicted by the encoders, or these by each other", stamp_s)

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
        if rest_s > dt_s + wheels.fresh_s:  # nothing was measured in between
            self._ekf.doubt(_TOP_SPEED_MPS * (rest_s - dt_s))
            self._bridged_m += _TOP_SPEED_MPS * (rest_s - dt_s)
        # After a gap of odometry the filter may already be part of the way along this step.
        share = rest_s / dt_s if rest_s < dt_s else 1.0
        self._move(self._ekf, stamp_s, forward_m * share, turn_rad * share)
        if self.owed_m and self._confirmed(stamp_s) and not any(
                source.strays or not source.usable(stamp_s) for source in (self._pose, self._gps)):
            self.owed_m = max(0.0, self.owed_m - abs(forward_m))

    def _move(self, ekf: PlanarEkf, stamp_s: float, forward_m: float, turn_rad: float | None
              ) -> None:
        """Predict up to a time; `turn_rad` is by the wheels, None without them."""
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
            self._gyro.flaw("turns differently from wheels and absolute pose", stamp_s)
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
        """Use the speed if the wheels are excluded, and the course if the absolute pose is."""
        along = velocity[0] * math.cos(ekf.yaw_rad) + velocity[1] * math.sin(ekf.yaw_rad)
        if not self._wheels.usable(stamp_s):
            self._speed_mps = along
        turning = abs(self._gyro.rate_radps) > _STRAIGHT_RADPS or not self._gyro.usable(stamp_s)
        if abs(along) < COURSE_FROM_MPS or turning or self._pose.usable(stamp_s):
            return
        sign = math.copysign(1.0, along)
        course = math.atan2(sign * velocity[1], sign * velocity[0])
        variance = (GPS_VELOCITY_SD_MPS / along) ** 2 + SIDESLIP_RAD**2
        if ekf.heading_nis(course, variance) <= self.limits.gate:
            ekf.update_heading(course, variance)

    def _bring_up(self, ekf: PlanarEkf, source: PositionSource, dt_s: float) -> tuple[float, float]:
        """Extrapolate a reading to the filter's time, update its offset, and return it.

        Without wheels the filter is predicted up to the reading at the last known speed.
        """
        rest_s = source.stamp_s - self._time_s
        if rest_s > 0 and not self._wheels.usable(source.stamp_s):
            self._move(ekf, source.stamp_s, self._speed_mps * rest_s, None)
        on_m = self._speed_mps * (self._time_s - source.stamp_s)
        x_m = source.reading[0] + on_m * math.cos(ekf.yaw_rad)
        y_m = source.reading[1] + on_m * math.sin(ekf.yaw_rad)
        # While it is open which source is wrong, and then for that source, averages are frozen.
        sure = self._pose.distrust or self._gps.distrust
        doubted = source.distrust if sure else (math.hypot(*self._apart) > self.limits.apart_m)
        source.see((x_m - self._track[0], y_m - self._track[1]), dt_s, self.limits,
                   doubted=bool(doubted))
        return x_m, y_m

    # -- isolation of faults --------------------------------------------------------------------

    def _compare(self, ekf: PlanarEkf, stamp_s: float) -> None:
        """Compare absolute pose and GPS with each other, and both with the wheels."""
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
        """Whether odometry, encoders and gyro are all received and agree."""
        parity = self._parity
        return (parity.confirmed(stamp_s) and parity.gyro_agrees
                and self._wheels.usable(stamp_s) and self._gyro.usable(stamp_s))

    def _contradict(self, stamp_s: float) -> None:
        """Exclude both positions: odometry, encoders and gyro agree on another motion."""
        self.owed_m = self.limits.proof_m
        for source in (self._pose, self._gps):
            source.flaw("moves differently from odometry, encoders and gyro", stamp_s)

    def _exclude(self, ekf: PlanarEkf, source: PositionSource, apart_m: float, stamp_s: float
                 ) -> None:
        source.flaw(f"moves differently from the others, {apart_m:.1f} m", stamp_s)
        # Its readings were used until now; those farther off than this failed the gate.
        doubt_m = min(apart_m, self.limits.contradiction_m / 2)
        ekf.doubt(doubt_m, doubt_m / 10)

    def _judge(self, ekf: PlanarEkf, source: PositionSource, other: PositionSource, fits: bool
               ) -> bool:
        """Update a source by whether its reading fits; return whether to use the reading."""
        stamp_s = source.stamp_s
        apart_m = math.hypot(*self._apart)
        if source.strays and not source.distrust \
                and not other.usable(stamp_s) \
                and self._wheels.usable(stamp_s) and self._gyro.usable(stamp_s):
            # One against one: dead reckoning drifts more slowly.
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
        """Restart from both positions, which agree: the prediction was wrong."""
        pose, gps = self._pose, self._gps
        if abs(wrap_angle(pose.reading[2] - ekf.yaw_rad)) > _GYRO_ASTRAY_RAD:
            self._gyro.flaw("turns do not fit the positions", stamp_s)
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
        """Keep a gyro excluded while it turns differently from the robot."""
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
        first = find_first(pose, gps, self._wheels, self._gyro, now_s=now_s,
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


def _timely(stamp_s: float, now_s: float) -> bool:
    return -AHEAD_S <= now_s - stamp_s <= _MAX_AGE_S
