"""Closed loop on the yaw rate: integral action against a dragging wheel. Pure.

The follower steers by heading error alone. A dragging wheel (blocked, or too weak for its speed)
turns the base, and a proportional controller has a constant error under a constant disturbance: the
robot drives beside its line, too far to measure the lights. So the difference between commanded and
measured yaw rate is integrated and added (feed-forward plus integral action, e.g. Astrom and
Murray, *Feedback Systems*, ch. 11).

Safeguards:

* A dead band covers the differences of a healthy base: without a fault the commands are unchanged
  to the bit.
* The reference is the delayed and ramped response of a healthy base, so acceleration is no error.
* The correction and its sum with the command are bounded. While the robot stands or the sum is at
  its bound, the integral is frozen (anti-windup). It leaks, so that it vanishes after a fault.

The speed has no loop. A base driven harder against a blocked wheel gains little and wears its
tyres; the mission takes longer instead.
"""

from __future__ import annotations

import math

GAIN_PER_S = 1.5
"""Gain of the integral."""

MOST_RADPS = 0.8
"""Largest correction."""

DEAD_BAND_RADPS = 0.12
"""Largest difference of a healthy base."""

LEAK_S = 20.0
"""Time constant of the leak."""

LAG_S = 0.2
"""Time constant of a healthy base, with communication."""

STANDING_MPS = 0.05
STANDING_RADPS = 0.05
"""The robot stands below both."""

GAP_S = 0.5
"""Longest time between two poses of a rate."""

WINDOW_S = 0.15
"""Time over which the yaw rate is measured."""


class MotionLoop:
    """Corrects the commanded turn rate.

    Args:
        max_angular_radps: bound of the corrected turn rate.
    """

    def __init__(self, max_angular_radps: float) -> None:
        self._top = max_angular_radps
        self._poses: list[tuple[float, float, float, float]] = []
        self._rate_radps = 0.0
        self._speed_mps = 0.0
        self._measured = False
        self._now_s = self._adopted_until_s = -math.inf
        self._expected_radps = 0.0
        self.added_radps = 0.0

    def adopt(self, added_radps: float, until_s: float) -> None:
        """Use the correction of the active loop until `until_s`.

        A loop whose commands are not executed would wind up.
        """
        self.added_radps = max(-MOST_RADPS, min(MOST_RADPS, added_radps))
        self._adopted_until_s = until_s

    def pose(self, stamp_s: float, x_m: float, y_m: float, yaw_rad: float) -> None:
        """Take a pose in `map` of the time `stamp_s`."""
        poses = self._poses
        if poses and not stamp_s > poses[-1][0]:
            return
        self._now_s = stamp_s
        if poses and stamp_s - poses[-1][0] > GAP_S:
            poses.clear()
        poses.append((stamp_s, x_m, y_m, yaw_rad))
        while len(poses) > 2 and stamp_s - poses[1][0] >= WINDOW_S - 1e-9:
            poses.pop(0)
        then_s, then_x_m, then_y_m, then_yaw_rad = poses[0]
        if stamp_s > then_s:
            dt_s = stamp_s - then_s
            self._rate_radps = math.remainder(yaw_rad - then_yaw_rad, math.tau) / dt_s
            self._speed_mps = math.dist((x_m, y_m), (then_x_m, then_y_m)) / dt_s
            self._measured = True

    def turn(self, linear_mps: float, angular_radps: float, dt_s: float) -> float:
        """Return the corrected turn rate, rad/s.

        Args:
            linear_mps: commanded speed.
            angular_radps: intended turn rate.
            dt_s: time since the last call.
        """
        follow = 1.0 - math.exp(-dt_s / LAG_S)
        self._expected_radps += follow * (angular_radps - self._expected_radps)
        self.added_radps *= math.exp(-dt_s / LEAK_S)
        if (linear_mps, angular_radps) == (0.0, 0.0):
            return 0.0
        stands = self._speed_mps < STANDING_MPS and abs(self._rate_radps) < STANDING_RADPS
        in_the_loop = self._measured and not stands and self._now_s >= self._adopted_until_s
        short = self._expected_radps - self._rate_radps if in_the_loop else 0.0
        short = math.copysign(max(abs(short) - DEAD_BAND_RADPS, 0.0), short)
        added = self.added_radps + GAIN_PER_S * short * dt_s
        added = max(-MOST_RADPS, min(MOST_RADPS, added))
        wanted = angular_radps + added
        turn = max(-self._top, min(self._top, wanted))
        if turn == wanted or abs(added) < abs(self.added_radps):
            self.added_radps = added
        return turn
