"""A source of positions as the pose filter sees it, and the filter's limits.

A source is held against dead reckoning by its *offset*: from the track that wheels and gyro give to
what it reads. The offset of an honest source stays where it is; by how much it has left its average
of the last seconds is the source's *deviation*.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import msgspec

from rampart.actors.osmosis.control.localization.motion_check import Source

_TOO_LONG_S = 1.0
"""After such a silence what was usual says nothing."""


class FilterLimits(msgspec.Struct, frozen=True):
    """Noise, gates and bounds; docs/localization.md says where the numbers come from.

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


@dataclass(slots=True)
class PositionSource(Source):
    """What is known of a source of positions.

    Attributes:
        patience: readings in a row that fail the gate before the source is excluded.
        reading: the newest: x m, y m, yaw rad.
        velocity: over ground in `map`, m/s, of a source that measures it.
        offset: from the dead-reckoned track to the newest reading, m.
        usual: the same, averaged over the last seconds; None before the first reading.
        fails: readings in a row that failed the gate.
        repeats: readings in a row that were the same to the last bit.
    """

    patience: int
    reading: tuple[float, float, float] = (0.0, 0.0, 0.0)
    velocity: tuple[float, float] = (0.0, 0.0)
    offset: tuple[float, float] = (0.0, 0.0)
    usual: tuple[float, float] | None = None
    fails: int = 0
    repeats: int = 0

    def see(self, offset: tuple[float, float], dt_s: float, average_s: float) -> None:
        """Take note of an offset from the track, `dt_s` after the last one."""
        self.offset = offset
        usual = self.usual
        if usual is None or dt_s > _TOO_LONG_S:
            self.usual = offset
        elif average_s < math.inf:
            gain = dt_s / average_s
            self.usual = (usual[0] + gain * (offset[0] - usual[0]),
                          usual[1] + gain * (offset[1] - usual[1]))

    def start_over(self) -> None:
        """Take the present offset for usual."""
        self.usual = self.offset

    @property
    def deviation_m(self) -> float:
        """How far it has lately moved otherwise than the wheels."""
        return 0.0 if self.usual is None else math.dist(self.offset, self.usual)
