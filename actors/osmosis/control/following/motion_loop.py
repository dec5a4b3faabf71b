"""Closed loop on the yaw rate: what the base turns is what the follower meant. Pure.

The follower steers by heading error alone. Against a wheel that drags (blocked, or too weak for its
speed) the base turns by itself, and a proportional controller answers a constant disturbance with
a constant error: the robot drives beside its line, too far to measure the lights. So the difference
between the yaw rate that was commanded and the one that the poses show is integrated and added
(feed-forward plus integral action, e.g. Astrom and Murray, *Feedback Systems*, ch. 11).

What keeps it harmless:

* A difference as small as a healthy base's is none (`DEAD_BAND_RADPS`): without a fault nothing is
  added, and the commands are the same to the bit.
* The reference is what a healthy base would do, delayed and ramped, so accelerating is no error.
* Bounded, and the sum stays within the turn rate's bound. While the robot stands, because it is
  stopped, braked or blocked, or the sum is at its bound, nothing more is added (anti-windup). What
  was added leaks away, so that a fault that is over is forgotten.

The speed is left open. A blocked wheel costs speed, and a base that is driven harder against it
gains little and wears its tyres; the mission takes longer instead.
"""

from __future__ import annotations

import math

# How the loop behaves.
GAIN_PER_S = 1.5
"""Of the integral."""

MOST_RADPS = 0.8
"""It adds at most this."""

DEAD_BAND_RADPS = 0.12
"""A smaller difference is that of a healthy base."""

LEAK_S = 20.0
"""Time constant in which what was added is forgotten."""

LAG_S = 0.2
"""Time constant of a healthy base and of the way to it."""

STANDING_MPS = 0.05
STANDING_RADPS = 0.05
"""Slower, the robot stands."""

GAP_S = 0.5
"""Poses farther apart than this say nothing about a rate."""

WINDOW_S = 0.15
"""Over which the yaw rate is measured."""


class MotionLoop:
    """Adds to the turn rate what the base is short of.

    Args:
        max_angular_radps: bound of the sum.
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
        """Add what another loop does, which sees its own commands executed, until `until_s`.

        One that is not in the loop would wind up: what it commands is not what the base does.
        """
        self.added_radps = max(-MOST_RADPS, min(MOST_RADPS, added_radps))
        self._adopted_until_s = until_s

    def pose(self, stamp_s: float, x_m: float, y_m: float, yaw_rad: float) -> None:
        """Take a pose in `map`, true at `stamp_s`."""
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
        """Return the turn rate to command for one that is meant, rad/s.

        Args:
            linear_mps: speed that is commanded with it.
            angular_radps: turn rate that is meant.
            dt_s: since the last call.
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
