"""Rotations as unit quaternions (w, x, y, z), in plain numbers: quick for single vectors."""

from __future__ import annotations

import math

from quadrotor.vehicle import Vector

Quaternion = tuple[float, float, float, float]

UNTURNED: Quaternion = (1.0, 0.0, 0.0, 0.0)


def product(a: Quaternion, b: Quaternion) -> Quaternion:
    """Return the rotation by b, then by a."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return (aw * bw - ax * bx - ay * by - az * bz, aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx, aw * bz + ax * by - ay * bx + az * bw)


def inverse(q: Quaternion) -> Quaternion:
    """Return the inverse rotation."""
    return q[0], -q[1], -q[2], -q[3]


def normal(q: Quaternion) -> Quaternion:
    """Return the quaternion scaled to length 1."""
    length = math.sqrt(sum(part * part for part in q)) or 1.0
    return q[0] / length, q[1] / length, q[2] / length, q[3] / length


def turn(q: Quaternion, v: Vector) -> Vector:
    """Return a rotated vector."""
    _, x, y, z = product(product(q, (0.0, *v)), inverse(q))
    return x, y, z


def by(vector_rad: Vector) -> Quaternion:
    """Return the rotation about a vector by its length, rad."""
    angle_rad = math.sqrt(sum(part * part for part in vector_rad))
    share = 0.5 if angle_rad < 1e-9 else math.sin(angle_rad / 2) / angle_rad
    return math.cos(angle_rad / 2), *(part * share for part in vector_rad)  # type: ignore[return-value]


def up(q: Quaternion) -> Vector:
    """Return the direction of the rotors' axis in `map`."""
    w, x, y, z = q
    return 2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)


def tilt(q: Quaternion) -> float:
    """Return the angle between the rotors' axis and the vertical, rad."""
    return math.acos(min(max(up(q)[2], -1.0), 1.0))


def yaw(q: Quaternion) -> float:
    """Return the yaw, rad."""
    w, x, y, z = q
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def leaning(axis: Vector, yaw_rad: float) -> Quaternion:
    """Return the attitude with the rotors' axis along a unit vector in `map`, and a yaw."""
    heading = (math.cos(yaw_rad / 2), 0.0, 0.0, math.sin(yaw_rad / 2))
    w = 1.0 + axis[2]
    return product(normal((w, -axis[1], axis[0], 0.0)), heading)
