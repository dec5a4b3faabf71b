"""A source of positions as the pose filter sees it, and the filter's limits.

A source is held against dead reckoning by its *offset*: from the track that wheels and gyro give to
what it reads. The offset of an honest source stays where it is; by how much it has left its average
of the last seconds is the source's *deviation*.

The filter starts from both positions if they agree, or from the only one (`find_first`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import msgspec

from rampart.actors.osmosis.control.localization.motion_check import ImuCheck, OdometryCheck, Source
from rampart.actors.osmosis.control.polyline import wrap_angle

GPS_VELOCITY_SD_MPS, SIDESLIP_RAD = 0.03, 0.03
COURSE_FROM_MPS = 0.4
"""Slower than this, the velocity over ground does not say where the robot is heading."""

ASTRAY_M, STRAY_M = 0.25, 0.4
"""By which a position may leave its average of some seconds, and of a minute."""

_APART_M = 0.3
_ALONE_S = 0.15
_IMU_SD_RAD = 0.05
_TOO_LONG_S = 1.0
"""After such a silence what was usual says nothing."""


class FilterLimits(msgspec.Struct, frozen=True):
    """Noise, gates and bounds; docs/case-study/localization.md says where the numbers come from.

    Args:
        bridge_m: how far the robot may go while fewer than two witnesses agree.
        largest_sd_m: no estimate beyond this standard deviation of the position.
        absolute_sd_m: of the absolute pose.
        absolute_sd_rad: of the absolute pose.
        gps_sd_m: of GPS at best; a receiver that claims worse is taken at its word.
        gate: largest normalised innovation squared of a position or heading: 5 sigma.
        apart_m: farther apart, on average, the absolute pose and GPS contradict each other.
        contradiction_m: so far apart neither is used, if nothing says which of them is wrong.
        way_m2_per_m: variance of dead reckoning per metre driven.
        way_m2_per_rad: the same per radian turned, when skid steering slips sideways.
        witness_s: over how long a position is held against dead reckoning.
        stray_s: the same for slow drifts, which leave no trace in that time.
        proof_m: way over which positions that were contradicted have to move as the wheels do.
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
    """What is known of a source of positions.

    Attributes:
        patience: readings in a row that fail the gate before the source is excluded.
        reading: the newest: x m, y m, yaw rad.
        velocity: over ground in `map`, m/s, of a source that measures it.
        offset: from the dead-reckoned track to the newest reading, m.
        usual: the same, averaged over the last seconds; None before the first reading.
        of_old: the same, averaged over a minute.
        fails: readings in a row that failed the gate.
        repeats: readings in a row that were the same to the last bit.
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
        """Take note of an offset from the track, `dt_s` after the last one."""
        self.offset = offset
        usual = self.usual
        if usual is None or dt_s > _TOO_LONG_S:
            self.start_over()
        elif not doubted:
            self.usual = _towards(usual, offset, dt_s / limits.witness_s)
            self.of_old = _towards(self.of_old, offset, dt_s / limits.stray_s)

    def start_over(self) -> None:
        """Take the present offset for usual."""
        self.usual = self.of_old = self.offset

    @property
    def deviation_m(self) -> float:
        """How far it has lately moved otherwise than the wheels."""
        return 0.0 if self.usual is None else math.dist(self.offset, self.usual)

    @property
    def strays(self) -> bool:
        """Whether it has moved otherwise than the wheels by more than their errors explain."""
        return self.usual is not None and (
            self.deviation_m > ASTRAY_M or math.dist(self.offset, self.of_old) > STRAY_M)


def _towards(here: tuple[float, float], there: tuple[float, float], share: float
             ) -> tuple[float, float]:
    return (here[0] + share * (there[0] - here[0]), here[1] + share * (there[1] - here[1]))


class FirstPose(msgspec.Struct, frozen=True):
    """Where to start.

    Attributes:
        source: whose newest reading is the position.
        yaw_rad: heading in `map`.
        heading_sd_rad: its standard deviation; None for that of the absolute pose.
    """

    source: PositionSource
    yaw_rad: float
    heading_sd_rad: float | None = None


def find_first(pose: PositionSource, gps: PositionSource, wheels: OdometryCheck, gyro: ImuCheck,
               *, now_s: float, waited_s: float) -> FirstPose | None:
    """Return where to start; None if that is not known yet.

    Without an absolute pose the heading is the IMU's, which was aligned before the mission, or
    else the course over ground of a robot that moves forward.

    Args:
        pose: the absolute pose.
        gps: GPS.
        wheels: for the direction of motion.
        gyro: the IMU.
        now_s: now.
        waited_s: since the first reading; a position that is alone is believed after a short wait.
    """
    by_pose, by_gps = pose.fresh(now_s), gps.fresh(now_s)
    if by_pose and by_gps:
        dt_s = pose.stamp_s - gps.stamp_s
        there = [at + v * dt_s for at, v in zip(gps.reading, gps.velocity, strict=False)]
        return FirstPose(pose, pose.reading[2]) \
            if math.dist(there, pose.reading[:2]) <= _APART_M else None
    # If it is neither, what came is late already, on a machine that is busy.
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
