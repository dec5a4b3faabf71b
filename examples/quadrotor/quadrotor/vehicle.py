"""Data of the vehicle, as in `quadrotor.xml`, and the mixer of its rotors."""

from __future__ import annotations

from collections.abc import Sequence

Vector = tuple[float, float, float]
Thrusts = tuple[float, float, float, float]

G_MPS2 = 9.81
MASS_KG = 1.5
INERTIA_KGM2: Vector = (0.018, 0.018, 0.032)
ARM_M = 0.16
"""Distance of each rotor from the centre, forward and sideways."""
DRAG_M = 0.016
"""Yaw torque of a rotor per thrust, N m / N."""
MOST_THRUST_N = 7.5
"""Largest thrust of one rotor; all four lift twice the weight."""
HOVER_N = MASS_KG * G_MPS2 / 4
HOME = (0.0, 0.0)
"""Place of takeoff and return, x and y in `map`, m."""

_PLACES = ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1))
"""Signs of x, y and yaw torque of each rotor."""


def mix(thrust_n: float, torque_nm: Vector) -> Thrusts:
    """Return the thrust of each rotor, N, within its limits.

    At the limits, roll and pitch come first, then the thrust, then yaw.

    Args:
        thrust_n: total thrust.
        torque_nm: torque about x, y and z of `base_link`.
    """
    roll_n, pitch_n = torque_nm[0] / (4 * ARM_M), torque_nm[1] / (4 * ARM_M)
    yaw_n = min(max(torque_nm[2] / (4 * DRAG_M), -0.8), 0.8)
    shares = [y * roll_n - x * pitch_n + turn * yaw_n for x, y, turn in _PLACES]
    lowest, highest = min(shares), max(shares)
    room_n = MOST_THRUST_N - (highest - lowest)
    if room_n < 0:
        shares = [share * MOST_THRUST_N / (highest - lowest) for share in shares]
        lowest, highest = min(shares), max(shares)
    mean_n = min(max(thrust_n / 4, -lowest), MOST_THRUST_N - highest)
    first, second, third, fourth = (
        min(max(mean_n + share, 0.0), MOST_THRUST_N) for share in shares)
    return first, second, third, fourth


def wrench(thrusts_n: Sequence[float]) -> tuple[float, Vector]:
    """Return total thrust, N, and torque about x, y and z of `base_link`, N m."""
    return sum(thrusts_n), (
        sum(y * ARM_M * f for (_, y, _), f in zip(_PLACES, thrusts_n, strict=True)),
        -sum(x * ARM_M * f for (x, _, _), f in zip(_PLACES, thrusts_n, strict=True)),
        sum(turn * DRAG_M * f for (_, _, turn), f in zip(_PLACES, thrusts_n, strict=True)))
