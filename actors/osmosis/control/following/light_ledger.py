"""The lights of a mission: each is measured in passing, and confirmed, or passed again. Pure.

**Measurement.** The illuminance at the sensor is linear in the intensities of the lights near it,
E = sum(I_j * g(d_j)), with the photometric model g of `rampart.actors.osmosis.airport.photometry`.
Samples are matched to poses by stamp. The intensity is the least-squares fit of the samples near a
light; a remaining pose error along the row is fitted too, as a shift. So neither noise nor a late
pose makes a good light look dim. A light is judged once, when the sensor has passed it with samples
before, over and behind it. With missing samples it is not judged, since no result is better than a
wrong one. Below half its nominal intensity a light is unserviceable (ICAO Annex 14, 10.4).

**Ledger.** It gives three guarantees, whichever node crashes at any time:

*No measurement is lost.* A measurement is saved before it is sent, and sent again until the Mission
Manager's status contains it. The Mission Manager saves it before it publishes that status.

*No light is measured twice.* A light counts as measured if it is in this ledger or in that status.
Both survive a restart.

*No light is skipped.* A measurement needs the whole pass over a light. If Osmosis Control crashed
or poses were missing, half of the samples are missing. (Saved samples would not help: there are
none from the time of the restart.) So the robot drives back and passes the light again. If that
fails too, as with a failed sensor, the light is given up, and so is every further one until a light
is measured again: a failed sensor costs one detour and not one per light.
"""

from __future__ import annotations

import bisect
import math
from collections import deque
from collections.abc import Iterable, Sequence
from operator import itemgetter

import msgspec
import numpy as np
from msgspec.structs import replace

from rampart.actors.osmosis.airport.model import Light
from rampart.actors.osmosis.airport.photometry import (
    SENSOR_FORWARD_M,
    illuminance_per_candela,
    sensor_position,
)
from rampart.actors.osmosis.control.following.light_row import LightRow
from rampart.actors.osmosis.control.polyline import Array, Point, Polyline
from rampart.actors.osmosis.messages import (
    LightMeasurement,
    LightVerdict,
    MissionStatus,
    Mode,
    Route,
)

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
                self._samples.setdefault(int(index), []).append((stamp_s, *place, lux))

    def _sensor_at(self, stamp_s: float) -> Point | None:
        after = bisect.bisect_left(self._poses, stamp_s, key=itemgetter(0))
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


_OVER_M = 0.5
"""Greatest distance of a light to the line of its row."""

RESEND_S = 0.5
"""Period in which an unconfirmed measurement is sent again."""

ROOM_M = 1.0
"""Distance before the first sample at which the robot turns around."""


class LightsKept(msgspec.Struct, frozen=True):
    """Saved state of the ledger.

    Attributes:
        mission_id: the mission of these lights.
        measured: measurements in order.
        given_up: names of lights that the second pass did not measure either.
        blind: whether no light was measured since the last one was given up.
    """

    mission_id: str = ""
    measured: tuple[LightMeasurement, ...] = ()
    given_up: tuple[str, ...] = ()
    blind: bool = False


class Detour(msgspec.Struct, frozen=True):
    """A light to pass again, and the arc length to drive back to."""

    light: str
    to_s_m: float


class LightLedger:
    """The lights of one mission at a time.

    Args:
        lights: lights of the airport.
    """

    def __init__(self, lights: Sequence[Light]) -> None:
        self._lights = tuple(lights)
        self._places = np.array([(li.x_m, li.y_m) for li in self._lights]).reshape(-1, 2)
        self._names = frozenset(light.name for light in self._lights)
        self._sent_s: dict[str, float] = {}
        self._shown: frozenset[str] | None = None
        self._gone_back_for = ""
        self.kept = LightsKept()

    @property
    def judged(self) -> frozenset[str]:
        """Names of the measured lights."""
        return frozenset(li.light for li in self.kept.measured) | (self._shown or frozenset())

    def begin(self, mission_id: str) -> None:
        """Begin a mission, unless it is under way."""
        if mission_id != self.kept.mission_id:
            self.restore(LightsKept(mission_id))

    def restore(self, kept: LightsKept) -> None:
        """Continue from a saved state; confirmations are received again."""
        self.kept = kept
        self._sent_s.clear()
        self._shown = None
        self._gone_back_for = ""

    def add(self, found: LightMeasurement, now: float) -> bool:
        """Add a measurement to send; return whether the light had none."""
        if found.light in self.judged:
            return False
        self.kept = replace(self.kept, measured=(*self.kept.measured, found), blind=False)
        self._sent_s[found.light] = now
        return True

    def confirm(self, status: MissionStatus) -> None:
        """Take the measurements that the Mission Manager has."""
        self._shown = None
        if status.mission_id == self.kept.mission_id:
            self._shown = self._names.intersection(light.light for light in status.lights)

    def to_send_again(self, now: float) -> list[LightMeasurement]:
        """Return the measurements that are due again, since the status does not contain them."""
        if self._shown is None:
            return []
        due = [m for m in self.kept.measured if m.light not in self._shown
               and now - self._sent_s.get(m.light, -RESEND_S) >= RESEND_S]
        self._sent_s.update((m.light, now) for m in due)
        return due

    def on_row(self, line: Polyline) -> tuple[tuple[float, str], ...]:
        """Return the lights of a row with their arc lengths, in order."""
        feet = line.coordinates(self._places, 0.0, line.length_m)
        return tuple(sorted(
            (float(s), light.name) for (s, n), light in zip(feet, self._lights, strict=True)
            if abs(n) <= ASIDE_M and 0.0 < s < line.length_m))

    def leave_out(self, row: Iterable[tuple[float, str]], s_m: float) -> None:
        """Give up the lights under the sensor while the robot passes an obstacle."""
        sensor_m = s_m + SENSOR_FORWARD_M
        out = tuple(name for at_m, name in row if abs(at_m - sensor_m) <= FIT_RADIUS_M
                    and name not in self.judged and name not in self.kept.given_up)
        if out:
            self.kept = replace(self.kept, given_up=(*self.kept.given_up, *out))

    def is_complete(self, row: Iterable[tuple[float, str]]) -> bool:
        """Whether every light of a row is measured or given up."""
        done = self.judged.union(self.kept.given_up)
        return all(name in done for _, name in row)

    def detour(self, row: Iterable[tuple[float, str]], s_m: float, *, ended: bool) -> Detour | None:
        """Return the detour for a light that was passed without a measurement, or None.

        There is none before the first status of the Mission Manager, which may have more lights.

        Args:
            row: lights of the row, from `on_row`.
            s_m: arc length of the robot on the row, driving forward.
            ended: the row has ended: lights count as passed at once.
        """
        if self._shown is None:
            return None
        judged = self.judged
        passed_m = s_m + SENSOR_FORWARD_M - (0.0 if ended else PASSED_M + ROOM_M / 4)
        for at_m, name in row:
            if at_m > passed_m or name in judged or name in self.kept.given_up:
                continue
            if self.kept.blind or name == self._gone_back_for:
                self.kept = replace(
                    self.kept, given_up=(*self.kept.given_up, name), blind=True)
                continue
            self._gone_back_for = name
            # From there the sensor makes the whole pass.
            to_s_m = at_m - FIT_RADIUS_M - SENSOR_FORWARD_M - ROOM_M
            return Detour(name, max(to_s_m, 0.0))
        return None


class RowInspection:
    """Inspection and ledger of the row that the robot drives; one mission at a time.

    Args:
        lights: lights of the airport.
        goes_back: whether the robot drives back for a missed light.

    Attributes:
        inspection: the measurements.
        ledger: the ledger of the mission.
        is_incomplete: whether the row has ended with a light neither measured nor given up.
    """

    def __init__(self, lights: tuple[Light, ...], *, goes_back: bool) -> None:
        self._lights = lights
        self._goes_back = goes_back
        self.inspection = LightInspection(lights)
        self._mission_id: str | None = None
        self._goal: tuple[str, int, Mode] | None = None
        self._due: dict[str, None] = {}
        self._row: tuple[tuple[float, str], ...] = ()
        self.ledger = LightLedger(lights)
        self.is_incomplete = False

    def confirm(self, status: MissionStatus) -> None:
        """Take the measurements that the Mission Manager has."""
        if self._goes_back:
            self.ledger.confirm(status)
            self.inspection.judged |= self.ledger.judged

    def begin(self, route: Route, row: LightRow | None) -> None:
        """Begin another route, and the row along it in light verification."""
        if route.mission_id != self._mission_id:
            self._mission_id = route.mission_id
            self.ledger.begin(route.mission_id)
            self.inspection = LightInspection(self._lights, judged=self.ledger.judged)
        goal = (*route.which, route.mode)
        if goal != self._goal:
            self._goal, self._due = goal, {}
        if route.mode is Mode.LIGHT_VERIFICATION and route.waypoints:
            line = Polyline(route.waypoints)
            feet = {light.name: line.project(light.x_m, light.y_m) for light in self._lights}
            self._due |= dict.fromkeys(
                name for name, foot in feet.items()
                if 0.0 < foot.s_m < line.length_m and abs(foot.n_m) <= _OVER_M)
        if row is not None:
            self._row = self.ledger.on_row(row.line)

    def measure(self, now_s: float, *, arrived: bool) -> list[LightMeasurement]:
        """Return the new measurements, to be saved before they are sent."""
        return [found for found in self.inspection.take(ended=arrived)
                if self.ledger.add(found, now_s)]

    def look_back(self, row: LightRow, *, arrived: bool) -> str:
        """Send the robot back for a light that was passed without a measurement.

        Args:
            row: the follower of the row.
            arrived: whether the robot has reached the end of the row.

        Returns:
            The light's name if the robot turns around now, or "".
        """
        self.is_incomplete = False
        s_m = row.progress_m
        if not self._goes_back or s_m is None or row.back_to is not None:
            return ""
        if row.is_off_course:
            self.ledger.leave_out(self._row, s_m)
            return ""
        detour = self.ledger.detour(self._row, s_m, ended=arrived)
        if detour is not None:
            row.go_back(detour.to_s_m)
        self.is_incomplete = arrived and not self.ledger.is_complete(self._row)
        return detour.light if detour is not None else ""

    @property
    def missed(self) -> tuple[str, ...]:
        """The unmeasured lights along all routes to this goal."""
        return tuple(name for name in self._due if name not in self.inspection.judged)
