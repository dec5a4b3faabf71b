"""Light sensor and inset lights: the illuminance that a light causes at the sensor.

An inset light is flush with the pavement and shines upwards; near the zenith its intensity I
(candela) is modelled as constant. The sensor is horizontal and faces down, at height h
above the ground and horizontal distance d from the light. With slant range r = sqrt(d^2 + h^2),
the inverse square law and the cosine law (cos = h / r) give the illuminance in lux

    E = (I / r^2) * (h / r) = I * h / (d^2 + h^2)^(3/2)

Illuminances add up. At h = 0.35 m a light 4 m away contributes less than 0.1 % of a light straight
below, so lights can be measured one by one.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

SENSOR_FORWARD_M = 0.45
"""Distance of the sensor ahead of `base_link`, on the robot's centre line."""

SENSOR_HEIGHT_M = 0.35
"""Height of the sensor above the ground."""


def sensor_position(x_m: float, y_m: float, yaw_rad: float) -> tuple[float, float]:
    """Return the sensor's position in `map` for a pose of `base_link` in `map`."""
    return (x_m + SENSOR_FORWARD_M * math.cos(yaw_rad), y_m + SENSOR_FORWARD_M * math.sin(yaw_rad))


def illuminance_per_candela(distance_m: float | NDArray[np.float64]) -> NDArray[np.float64]:
    """Return E / I, in lux per candela, at horizontal distances `distance_m`."""
    square = distance_m**2 + SENSOR_HEIGHT_M**2
    return np.asarray(SENSOR_HEIGHT_M / (square * np.sqrt(square)))
