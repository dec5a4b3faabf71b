"""Tangential escape: chooses the side and the lateral offset for passing an obstacle.

It works in route coordinates (s, n), see `rampart.actors.osmosis.control.polyline`. Each echo
forbids an interval of offsets, as wide as the robot and its clearance. If offset 0 is forbidden,
the nearest free offset to the right or left is chosen, and the side is kept until the obstacle is
behind. This commitment avoids a local minimum in front of an obstacle exactly on the line. A
restarted robot beside an obstacle chooses the side where it is. If neither side is free within the
corridor, the robot waits.
"""

from __future__ import annotations

import math

import msgspec
import numpy as np

from rampart.actors.osmosis.control.polyline import Array, Hull


class EscapeLimits(msgspec.Struct, frozen=True):
    """Room for the escape, in metres.

    Args:
        range_m: distance ahead along the route, from the robot's centre, at which an escape begins.
        depth_m: further distance of echoes that are considered, since the tip of an obstacle alone
            may suggest the wrong side.
        clearance_m: preferred distance of the hull's side to an obstacle.
        least_clearance_m: least distance where the corridor is narrow.
        max_deviation_m: largest offset from the route. With 2.5 m of pavement on each side it
            leaves the 1.07 m between the robot's centre and the grass that DM1 requires.
        group_m: obstacles closer to each other along the route are passed as one.
        detour_m: additional offset for which more distant obstacles are passed as one.
        yielding_m: tolerance in clearance and offset for the chosen side.
        turning_room_m: least distance to the obstacle for a change of side.
        return_slope: lateral metres back to the line per metre along the route.
    """

    range_m: float = 3.0
    depth_m: float = 1.5
    clearance_m: float = 0.4
    least_clearance_m: float = 0.28
    max_deviation_m: float = 1.3
    group_m: float = 1.3
    detour_m: float = 0.4
    yielding_m: float = 0.1
    turning_room_m: float = 1.6
    return_slope: float = 0.6


class Deviation(msgspec.Struct, frozen=True, gc=False):
    """Lateral offset from the route, left positive.

    `gap_m` is the distance along the route from the robot's centre to the first echo in its
    present lane, infinite if the lane is free. `possible` is False if neither side is free.
    """

    offset_m: float
    gap_m: float
    possible: bool


class Escape:
    """Chooses a side once per obstacle: -1 right, 1 left, 0 none."""

    def __init__(self, hull: Hull, limits: EscapeLimits) -> None:
        self._hull = hull
        self._limits = limits
        self._s_m = math.nan
        self._until_m = -math.inf
        self.side = 0
        self.offset_m = 0.0

    def update(self, echoes: Array, s_m: float, n_m: float) -> Deviation:
        """Return the deviation for a robot at (s, n).

        Args:
            echoes: laser echoes in route coordinates, shape (k, 2).
            s_m: the robot's progress along the route.
            n_m: its lateral offset, left positive.
        """
        if math.isnan(self._s_m):  # first step: return gradually from the present offset
            self._s_m = s_m
            reach = self._limits.max_deviation_m
            self.offset_m = min(max(n_m, -reach), reach)
        travelled_m = max(s_m - self._s_m, 0.0)
        self._s_m = max(s_m, self._s_m)
        near = self._with_bodies(self._relevant(echoes, s_m), s_m, n_m)
        offset_m, possible = self._choose(near, s_m, n_m)
        if self.side == 0:
            step_m = self._limits.return_slope * travelled_m
            shrunk = math.copysign(max(abs(self.offset_m) - step_m, 0.0), self.offset_m)
            if self._is_free(near, shrunk, self._hull.half_width_m):
                offset_m = shrunk
        self.offset_m = offset_m
        return Deviation(offset_m, self._gap(near, s_m, n_m), possible)

    def _relevant(self, echoes: Array, s_m: float) -> Array:
        """Return the echoes that are not behind and near the corridor, sorted by s."""
        if not len(echoes):
            return echoes
        behind_m = self._hull.half_length_m + 0.15
        ahead = echoes[:, 0] - s_m
        width = self._limits.max_deviation_m + self._hull.half_width_m + self._limits.clearance_m
        far_m = self._limits.range_m + self._limits.depth_m
        kept = echoes[(ahead > -behind_m) & (ahead < far_m) & (np.abs(echoes[:, 1]) < width)]
        return np.asarray(kept[np.argsort(kept[:, 0], kind="stable")])

    def _with_bodies(self, near: Array, s_m: float, n_m: float) -> Array:
        """Add the unseen body of a passed obstacle at the line.

        Beside an obstacle only its flank is visible. The far side of an echo between the robot and
        the line may reach the line, so the line is not free until the obstacle is behind.
        """
        if not len(near) or abs(n_m) < self._hull.half_width_m:
            return near
        aside = near[:, 1] * math.copysign(1.0, n_m)
        upto_m = max(s_m + self._hull.length_m, self._until_m + 0.3 if self.side else -math.inf)
        flank = near[(aside > 0.0) & (aside < abs(n_m)) & (near[:, 0] < upto_m)]
        if len(flank) == 0:
            return near
        bodies = np.column_stack((flank[:, 0], np.zeros(len(flank))))
        joint = np.concatenate((near, bodies))
        return np.asarray(joint[np.argsort(joint[:, 0], kind="stable")])

    def _gap(self, near: Array, s_m: float, n_m: float) -> float:
        if not len(near):
            return math.inf
        lane = np.abs(near[:, 1] - n_m) < self._hull.half_width_m + self._limits.least_clearance_m
        ahead = near[lane & (near[:, 0] > s_m), 0]
        return float(ahead.min()) - s_m if len(ahead) else math.inf

    def _choose(self, near: Array, s_m: float, n_m: float) -> tuple[float, bool]:
        """Keep or choose the side; return the offset and whether it is free."""
        keep_off_m = self._hull.half_width_m + self._limits.least_clearance_m
        if not len(near) or self._is_free(
                near[near[:, 0] - s_m < self._limits.range_m], 0.0, keep_off_m):
            self.side = 0
            self._until_m = -math.inf
            return 0.0, True
        ends = np.flatnonzero(np.diff(near[:, 0]) > self._limits.group_m) + 1
        groups = (near[:end] for end in (*ends, len(near)))
        group = next(part for part in groups if not self._is_free(part, 0.0, keep_off_m))
        first_m = float(group[np.abs(group[:, 1]) < keep_off_m, 0].min())
        if first_m > self._until_m + self._limits.group_m / 2:
            self.side = 0  # the obstacle of this side is passed
        kept = self.side
        for side in (kept, -kept) if kept else self._preferred(group, n_m):
            offset_m = self._offset(group, side, yielding=side == kept)
            if offset_m is None:
                continue
            if kept == -side and first_m - s_m < self._limits.turning_room_m:
                continue  # too late for a change of side: wait
            farther_m = self._offset(near, side, yielding=side == kept)
            if farther_m is not None and abs(farther_m - offset_m) <= self._limits.detour_m:
                offset_m = farther_m
            self.side = side
            self._until_m = float(group[-1, 0])
            return offset_m, True
        return self.offset_m, False

    def _preferred(self, group: Array, n_m: float) -> tuple[int, int]:
        """Return the sides by preference: the shorter detour from the robot, then the right."""

        def cost(side: int) -> float:
            offset_m = self._offset(group, side, yielding=False)
            if offset_m is None:
                return math.inf
            return abs(offset_m) + 0.5 * abs(offset_m - n_m)

        return (1, -1) if cost(1) < cost(-1) - 0.1 else (-1, 1)

    def _offset(self, echoes: Array, side: int, *, yielding: bool) -> float | None:
        """Return the nearest free offset on a side with the best clearance available, or None."""
        slack_m = self._limits.yielding_m if yielding else 0.0
        reach_m = self._limits.max_deviation_m + slack_m
        least_m = self._hull.half_width_m + self._limits.least_clearance_m - slack_m
        wished_m = self._hull.half_width_m + self._limits.clearance_m
        nearest_m = self._free_from(echoes, side, least_m)
        if nearest_m > reach_m:
            return None
        for offset_m in (self._free_from(echoes, side, wished_m), self._limits.max_deviation_m):
            if offset_m <= reach_m and self._is_free(echoes, side * offset_m, least_m):
                return side * offset_m
        return side * nearest_m

    @staticmethod
    def _is_free(echoes: Array, offset_m: float, keep_off_m: float) -> bool:
        return not len(echoes) or not bool(
            np.count_nonzero(np.abs(echoes[:, 1] - offset_m) < keep_off_m - 1e-9))

    @staticmethod
    def _free_from(echoes: Array, side: int, keep_off_m: float) -> float:
        """Return the magnitude of the smallest offset of a side that no echo forbids."""
        offset_m = 0.0
        for n_m in np.sort(echoes[:, 1] * side):
            if abs(n_m - offset_m) < keep_off_m - 1e-9:
                offset_m = float(n_m) + keep_off_m
        return offset_m
