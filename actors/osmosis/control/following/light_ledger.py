"""Ledger of the lights of a mission: measured, confirmed, or to be passed again. Pure.

It gives three guarantees, whichever node crashes at any time:

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

from collections.abc import Iterable, Sequence

import msgspec
import numpy as np
from msgspec.structs import replace

from rampart.actors.osmosis.airport.model import Light
from rampart.actors.osmosis.airport.photometry import SENSOR_FORWARD_M
from rampart.actors.osmosis.control.following.light_inspection import (
    ASIDE_M,
    FIT_RADIUS_M,
    PASSED_M,
    LightInspection,
)
from rampart.actors.osmosis.control.following.light_row import LightRow
from rampart.actors.osmosis.control.polyline import Polyline
from rampart.actors.osmosis.messages import LightMeasurement, MissionStatus, Mode, Route

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
