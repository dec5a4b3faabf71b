"""Potential field of taxi mode: attraction to the route, repulsion from what the laser sees.

The field lives in `base_link`. The paper's own field repels from the robot's centre with
4*alpha*(d_s^2 - d^2); here distances are those of the hull and the repulsion is Khatib's
alpha*(1/d - 1/d_s) (Khatib 1986), which grows without bound towards contact instead of fading.

A field alone has a local minimum in front of an obstacle that stands exactly on the line. The
tangential part of the escape is therefore not a force but a choice, made in
`rampart.actors.osmosis.control.following.escape`: the point of attraction moves sideways, to one
side, and stays there. What is left to the field is the last half metre, for which it is good.
"""

from __future__ import annotations

import math

import numpy as np

from rampart.actors.osmosis.control.polyline import Array, Hull

_NEAR_M = 0.1
"""Nearer than this to the target the attraction fades."""

# Shape of the field.
INFLUENCE_M = 0.9
"""The distance d_s from the hull at which repulsion begins."""

REPULSION = 0.06
"""At 0.06 an echo 0.1 m aside turns the way by 28 degrees."""

LEAST_DISTANCE_M = 0.05
"""Distances below this repel no stronger."""

LEAST_ADVANCE = 0.15
"""Part of the attraction which opposing repulsion leaves, so that the field turns the robot aside
but never about."""


def clusters(points: Array, gap_m: float = 0.5) -> list[Array]:
    """Split echoes, in the order of the sweep, into obstacles wherever neighbours are apart."""
    steps = np.hypot(*np.diff(points, axis=0).T)
    return np.split(points, np.flatnonzero(steps > gap_m) + 1)


def repulsion(points: Array, hull: Hull) -> tuple[float, float]:
    """Sum over the obstacles of the push of each one's nearest echo, in `base_link`.

    One echo per obstacle: else the push would depend on the laser's resolution.
    """
    push_x = push_y = 0.0
    if not len(points) or float(hull.distance(points).min()) >= INFLUENCE_M:
        return push_x, push_y  # as nearly always
    for cluster in clusters(points):
        distances = hull.distance(cluster)
        nearest = int(np.argmin(distances))
        distance_m = max(float(distances[nearest]), LEAST_DISTANCE_M)
        if distance_m >= INFLUENCE_M:
            continue
        x_m, y_m = (float(v) for v in cluster[nearest])
        away_x = min(max(x_m, -hull.half_length_m), hull.half_length_m) - x_m
        away_y = min(max(y_m, -hull.half_width_m), hull.half_width_m) - y_m
        norm = math.hypot(away_x, away_y)
        if norm < 1e-9:  # inside the hull: away from the centre is all there is to say
            away_x, away_y, norm = -x_m, -y_m, max(math.hypot(x_m, y_m), 1e-9)
        size = REPULSION * (1.0 / distance_m - 1.0 / INFLUENCE_M)
        push_x += size * away_x / norm
        push_y += size * away_y / norm
    return push_x, push_y


def field(target_x_m: float, target_y_m: float, points: Array, hull: Hull) -> tuple[float, float]:
    """Return the field's vector at the robot, in `base_link`; its direction is where to go.

    Args:
        target_x_m: point of attraction in `base_link`.
        target_y_m: point of attraction in `base_link`.
        points: laser echoes in `base_link`, shape (n, 2), in the order of the sweep.
        hull: footprint of the robot.
    """
    # A unit vector to the target, shrinking linearly near it (paper's conic-quadratic).
    scale = max(math.hypot(target_x_m, target_y_m), _NEAR_M)
    pull_x, pull_y = target_x_m / scale, target_y_m / scale
    push_x, push_y = repulsion(points, hull)
    pull = math.hypot(pull_x, pull_y)
    if pull < 1e-9:
        return push_x, push_y
    ahead_x, ahead_y = pull_x / pull, pull_y / pull
    along = max(pull + push_x * ahead_x + push_y * ahead_y, LEAST_ADVANCE * pull)
    aside = ahead_x * push_y - ahead_y * push_x
    return along * ahead_x - aside * ahead_y, along * ahead_y + aside * ahead_x
