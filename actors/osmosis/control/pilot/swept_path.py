"""Swept path: the highest speed along a commanded arc without touching an echo.

The footprint is moved along the arc over the stopping distance of the speed. An echo blocks if the
hull comes nearer to it than the margin *and* nearer than it is now, so a close echo beside or
behind the robot never prevents it from moving away. A lower speed needs less room, so the speed is
reduced to the highest that fits. The turn rate is kept while turning is safe, so that the robot can
turn away in front of an obstacle.
"""

from __future__ import annotations

import math

import msgspec
import numpy as np

from rampart.actors.osmosis.control.polyline import Array, Hull

_NEARER_M = 0.01
"""Smaller approaches are laser noise."""

_CRAWL_MPS = 0.08
"""Below this speed the robot stops, since it would jerk with the laser's noise."""


class StoppingRoom(msgspec.Struct, frozen=True):
    """Free room that a speed requires.

    Args:
        hull: footprint.
        top_speed_mps: speed at which the two distances below hold.
        stop_distance_m: free distance ahead of the hull at top speed; the braking distance applies
            if it is larger.
        lateral_distance_m: free distance beside the hull at top speed.
        deceleration_mps2: guaranteed deceleration.
        reaction_s: time from the scan until the wheels brake.
        margin_m: distance ahead of the hull after a stop.
        touch_m: distance beside the hull at any speed.
        angular_deceleration_radps2: deceleration of a turn.
    """

    hull: Hull = Hull()
    top_speed_mps: float = 1.0
    stop_distance_m: float = 0.8
    lateral_distance_m: float = 0.3
    deceleration_mps2: float = 1.5
    reaction_s: float = 0.15
    margin_m: float = 0.2
    touch_m: float = 0.05
    angular_deceleration_radps2: float = 4.0

    def ahead_m(self, speed_mps: float) -> float:
        """Return the free distance ahead of the hull that a speed requires."""
        top = self.top_speed_mps
        spare = self.stop_distance_m - self.margin_m - top**2 / (2 * self.deceleration_mps2)
        reaction_s = max(self.reaction_s, spare / top)
        braking_m = speed_mps**2 / (2 * self.deceleration_mps2)
        return self.margin_m + abs(speed_mps) * reaction_s + braking_m

    def beside_m(self, speed_mps: float) -> float:
        """Return the free distance beside the hull that a speed requires."""
        share = min(abs(speed_mps) / self.top_speed_mps, 1.0)
        return self.touch_m + max(self.lateral_distance_m - self.touch_m, 0.0) * share

    def turn_rad(self, rate_radps: float) -> float:
        """Return the angle turned until a turn has stopped."""
        stopping_s = self.reaction_s + abs(rate_radps) / (2 * self.angular_deceleration_radps2)
        return abs(rate_radps) * stopping_s


def is_free(linear_mps: float, angular_radps: float, points: Array, room: StoppingRoom) -> bool:
    """Whether the robot may execute a command.

    Args:
        linear_mps: forward speed, negative backwards.
        angular_radps: turn rate.
        points: laser echoes in `base_link`, shape (n, 2).
        room: required room.
    """
    if abs(linear_mps) < 1e-6:
        linear_mps = 0.0
    margin_m = room.beside_m(linear_mps)
    path_m = max(room.ahead_m(linear_mps) - margin_m, 0.0) if linear_mps else 0.0
    reach_m = room.hull.turning_radius_m + path_m + margin_m
    near = points[np.hypot(points[:, 0], points[:, 1]) < reach_m]
    if len(near) == 0 or (linear_mps == 0.0 and angular_radps == 0.0):
        return True
    x, y, yaw = _arc(linear_mps, angular_radps, path_m, room)
    cos, sin = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
    dx, dy = near[None, :, 0] - x[:, None], near[None, :, 1] - y[:, None]
    seen = np.stack((cos * dx + sin * dy, cos * dy - sin * dx), axis=-1)
    distance = room.hull.distance(seen)
    in_the_way = (distance < margin_m) & (distance < distance[0] - _NEARER_M)
    return not bool(in_the_way.any())


def _arc(linear_mps: float, angular_radps: float, path_m: float,
         room: StoppingRoom) -> tuple[Array, Array, Array]:
    """Return poses along the arc in `base_link`; it is straight where the turn has stopped."""
    turn_rad = math.copysign(room.turn_rad(angular_radps), angular_radps)
    if path_m == 0.0:
        yaw = np.linspace(0.0, turn_rad, 9)
        return np.zeros(9), np.zeros(9), yaw
    limit = max(abs(turn_rad), abs(angular_radps) * 1.0)
    turned = min(abs(angular_radps) * path_m / abs(linear_mps), limit)
    count = 2 + math.ceil(path_m / 0.06 + turned / 0.15)
    length = np.linspace(0.0, path_m, count)
    yaw = np.clip(angular_radps * length / abs(linear_mps), -limit, limit)
    step = path_m / (count - 1) * math.copysign(1.0, linear_mps)
    middle = (yaw[:-1] + yaw[1:]) / 2
    x = np.concatenate(((0.0,), np.cumsum(step * np.cos(middle))))
    y = np.concatenate(((0.0,), np.cumsum(step * np.sin(middle))))
    return x, y, yaw


def limited(linear_mps: float, angular_radps: float, points: Array,
            room: StoppingRoom) -> tuple[float, float]:
    """Return the command with the highest safe speed; zero if no motion is safe.

    The speed is reduced in steps of a twentieth, then the turn rate.
    """
    if is_free(linear_mps, angular_radps, points, room):
        return linear_mps, angular_radps
    for share in np.linspace(0.95, 0.0, 20):
        slower_mps = float(linear_mps * share)
        if abs(slower_mps) < _CRAWL_MPS:
            break
        if is_free(slower_mps, angular_radps, points, room):
            return slower_mps, angular_radps
    for share in (1.0, 0.5, 0.25):
        if is_free(0.0, angular_radps * share, points, room):
            return 0.0, angular_radps * share
    return 0.0, 0.0
