"""Measures the intensity of each light of a row in passing.

The illuminance at the sensor is linear in the intensities of the lights near it,
E = sum(I_j * g(d_j)), with the photometric model g of `rampart.actors.osmosis.airport.photometry`.
Samples are matched to poses by stamp. The intensity is the least-squares fit of the samples near a
light; a remaining pose error along the row is fitted too, as a shift. So neither noise nor a late
pose makes a good light look dim.

A light is judged once, when the sensor has passed it with samples before, over and behind it. With
missing samples it is not judged, since no result is better than a wrong one. Below half its nominal
intensity a light is unserviceable (ICAO Annex 14, 10.4).
"""

from __future__ import annotations

import bisect
import math
from collections import deque
from collections.abc import Iterable
from operator import itemgetter

import numpy as np

from rampart.actors.osmosis.airport.model import Light
from rampart.actors.osmosis.airport.photometry import illuminance_per_candela, sensor_position
from rampart.actors.osmosis.control.polyline import Array, Point
from rampart.actors.osmosis.messages import LightMeasurement, LightVerdict

DIM_BELOW = 0.5
"""Ratio of measured to nominal intensity below which a light is dim (ICAO Annex 14, 10.4)."""

OUT_BELOW = 0.05
"""Ratio below which it is out."""

# Requirements of a measurement.
FIT_RADIUS_M = 0.8
"""Horizontal distance of the samples in the fit of a light."""

SPAN_M = 0.3
"""Samples must reach this far before and behind the light."""

ASIDE_M = 0.35
"""Greatest lateral distance of the sensor to the light."""

LARGEST_GAP_M = 0.15
"""Greatest distance between neighbouring samples of a fit."""

LEAST_SAMPLES = 8
"""Least number of samples of a fit."""

PASSED_M = 0.9
"""Distance of the sensor to a light that is passed."""

NEIGHBOUR_M = 4.0
"""Lights closer to each other are fitted together."""

SHIFT_M = 0.15
"""Largest shift along the row for a pose error."""

POSE_GAP_S = 0.3
"""Greatest time between the two poses around a sample."""

KEEP_S = 120.0
"""Older samples are dropped: the pose of a robot that waited may have changed."""


def verdict(ratio: float) -> LightVerdict:
    """Return the verdict on a ratio of measured to nominal intensity."""
    if ratio < OUT_BELOW:
        return LightVerdict.OUT
    return LightVerdict.DIM if ratio < DIM_BELOW else LightVerdict.OK


class LightInspection:
    """Collects poses and samples, and measures each passed light once.

    Args:
        lights: lights that may be passed.
        judged: names of measured lights.
    """

    def __init__(self, lights: Iterable[Light], judged: Iterable[str] = ()) -> None:
        self._lights = tuple(lights)
        self._places = np.array([(li.x_m, li.y_m) for li in self._lights]).reshape(-1, 2)
        self._x_m, self._y_m = np.ascontiguousarray(self._places.T)
        self.judged: set[str] = set(judged)
        self._poses: deque[tuple[float, float, float, float]] = deque(maxlen=60)
        self._waiting: deque[tuple[float, float]] = deque(maxlen=60)
        self._samples: dict[int, list[tuple[float, float, float, float]]] = {}

    def pose(self, stamp_s: float, x_m: float, y_m: float, yaw_rad: float) -> None:
        """Take a pose of `base_link` in `map` of a time; older ones are ignored."""
        if not self._poses or stamp_s > self._poses[-1][0]:
            self._poses.append((stamp_s, x_m, y_m, yaw_rad))

    def sample(self, stamp_s: float, illuminance_lux: float) -> None:
        """Take a reading of the light sensor."""
        self._waiting.append((stamp_s, illuminance_lux))

    def take(self, *, ended: bool = False) -> list[LightMeasurement]:
        """Return the measurements of lights passed since the last call.

        Args:
            ended: the row has ended: also judge lights that are not passed by `PASSED_M`.
        """
        self._place_samples()
        found: list[LightMeasurement] = []
        if not self._poses:
            return found
        here = sensor_position(*self._poses[-1][1:])
        for index in list(self._samples):
            light = self._lights[index]
            distance_m = math.dist(here, (light.x_m, light.y_m))
            if distance_m < PASSED_M and not ended:
                continue
            samples = self._samples.pop(index)
            intensity_cd = self._fit(index, samples)
            if intensity_cd is None or light.name in self.judged:
                continue
            ratio = intensity_cd / light.nominal_cd
            self.judged.add(light.name)
            found.append(LightMeasurement(light.name, intensity_cd, ratio, verdict(ratio)))
        return found

    def _place_samples(self) -> None:
        """Assign each sample between two poses its position, and the sample to the lights near."""
        while self._waiting and self._poses and self._waiting[0][0] <= self._poses[-1][0]:
            stamp_s, lux = self._waiting.popleft()
            place = self._sensor_at(stamp_s)
            if place is None or not self._lights:
                continue
            off_m = np.hypot(self._x_m - place[0], self._y_m - place[1])
            for index in np.flatnonzero(off_m <= FIT_RADIUS_M):
                samples = self._samples.setdefault(int(index), [])
                if samples and stamp_s - samples[0][0] > KEEP_S:
                    samples.clear()
                samples.append((stamp_s, *place, lux))

    def _sensor_at(self, stamp_s: float) -> Point | None:
        after = bisect.bisect_left(self._poses, stamp_s, key=itemgetter(0))
        if after >= len(self._poses):
            return None
        b_s, bx, by, b_yaw = self._poses[after]
        if b_s == stamp_s:
            return sensor_position(bx, by, b_yaw)
        a_s, ax, ay, a_yaw = self._poses[after - 1]
        if after == 0 or b_s - a_s > POSE_GAP_S:
            return None
        share = (stamp_s - a_s) / (b_s - a_s)
        turn = math.remainder(b_yaw - a_yaw, math.tau)
        return sensor_position(ax + share * (bx - ax), ay + share * (by - ay),
                               a_yaw + share * turn)

    def _fit(self, index: int, samples: list[tuple[float, float, float, float]]) -> float | None:
        """Return the intensity in candela by least squares, or None if samples are missing."""
        if len(samples) < LEAST_SAMPLES:
            return None
        table = np.array(samples)
        places, lux = table[:, 1:3], table[:, 3]
        along = self._way(places)
        relative = places - self._places[index]
        ahead = relative @ along
        aside = np.abs(relative @ np.array((-along[1], along[0])))
        order = np.argsort(ahead)
        near = np.abs(ahead) < SPAN_M
        gaps = np.diff(ahead[order])
        if ahead.min() > -SPAN_M or ahead.max() < SPAN_M or not near.any() \
                or aside[near].min() > ASIDE_M or gaps.max() > LARGEST_GAP_M:
            return None
        others = np.hypot(*(self._places - self._places[index]).T) <= NEIGHBOUR_M
        others[index] = False
        columns = np.concatenate(((index,), np.flatnonzero(others)))
        best = (math.inf, 0.0)
        for shift_m in np.linspace(-SHIFT_M, SHIFT_M, 31):
            moved = places + shift_m * along
            offsets = moved[:, None, :] - self._places[None, columns, :]
            kernel = illuminance_per_candela(np.hypot(offsets[:, :, 0], offsets[:, :, 1]))
            # Neighbours beyond the fit's radius contribute little: damping keeps them bounded.
            normal = kernel.T @ kernel + np.diag([0.0] + [1e-4] * (len(columns) - 1))
            solution = np.linalg.solve(normal, kernel.T @ lux)
            misfit = float(np.sum((kernel @ solution - lux) ** 2))
            if misfit < best[0]:
                best = (misfit, float(solution[0]))
        return max(best[1], 0.0)

    @staticmethod
    def _way(places: Array) -> Array:
        """Return the unit vector of the direction of motion."""
        centred = places - places.mean(axis=0)
        _, _, axes = np.linalg.svd(centred, full_matrices=False)
        along: Array = axes[0]
        return along if (places[-1] - places[0]) @ along >= 0 else -along
