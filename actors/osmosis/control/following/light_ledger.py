"""Which lights of a mission are measured, who knows it, and which one has to be gone back for.

Three promises, whatever dies when:

*None is lost.* A measurement is kept before it is sent, and sent again until the Mission Manager's
status shows it; the Mission Manager shows it when it has kept it in its turn.

*None is measured twice.* A light is judged if it is in this ledger or in that status. Both survive
their nodes; either is enough.

*None is skipped.* A measurement needs the whole pass over a light. If the pass was cut, because
Osmosis Control died or no pose came, half the samples are missing for good. (To keep the samples
would not help: those of the time in which nobody listened are missing too.) So the robot drives
back and passes the light again. If it cannot be measured then either, as with a sensor that has
failed, it is given up, and so is every other that is missed before one has been measured again: a
dead sensor costs one detour, not one for each light.

Pure: no clock, no messages sent, no bus.
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
"""A light this near to the row's line is one of the row."""

RESEND_S = 0.5
"""A measurement that the Mission Manager does not show is sent again after so long."""

ROOM_M = 1.0
"""The robot turns round so far before the place where the sensor has to begin."""


class LightsKept(msgspec.Struct, frozen=True):
    """What the ledger must not forget.

    Attributes:
        mission_id: whose lights these are.
        measured: in order of measurement.
        given_up: names of lights that could not be measured in the second pass either.
        blind: no light was measured since the last one was given up.
    """

    mission_id: str = ""
    measured: tuple[LightMeasurement, ...] = ()
    given_up: tuple[str, ...] = ()
    blind: bool = False


class Detour(msgspec.Struct, frozen=True):
    """Where to go back to on a row, as arc length, and for which light."""

    light: str
    to_s_m: float


class LightLedger:
    """The lights of one mission at a time.

    Args:
        lights: of the airport.
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
        """Names of the lights that have their measurement."""
        return frozenset(li.light for li in self.kept.measured) | (self._shown or frozenset())

    def begin(self, mission_id: str) -> None:
        """Begin a mission, unless it is the one that is under way."""
        if mission_id != self.kept.mission_id:
            self.restore(LightsKept(mission_id))

    def restore(self, kept: LightsKept) -> None:
        """Go on from what was kept; who knows of it has to be heard anew."""
        self.kept = kept
        self._sent_s.clear()
        self._shown = None
        self._gone_back_for = ""

    def add(self, found: LightMeasurement, now: float) -> bool:
        """Take a measurement that is about to be sent; return whether the light had none."""
        if found.light in self.judged:
            return False
        self.kept = replace(self.kept, measured=(*self.kept.measured, found), blind=False)
        self._sent_s[found.light] = now
        return True

    def hear(self, status: MissionStatus) -> None:
        """Take note of what the Mission Manager has."""
        self._shown = None
        if status.mission_id == self.kept.mission_id:
            self._shown = self._names.intersection(light.light for light in status.lights)

    def to_send_again(self, now: float) -> list[LightMeasurement]:
        """Return what the Mission Manager should have and does not show."""
        if self._shown is None:
            return []
        due = [m for m in self.kept.measured if m.light not in self._shown
               and now - self._sent_s.get(m.light, -RESEND_S) >= RESEND_S]
        self._sent_s.update((m.light, now) for m in due)
        return due

    def on_row(self, line: Polyline) -> tuple[tuple[float, str], ...]:
        """Return the lights that a row passes over, each with its arc length, in order."""
        feet = line.coordinates(self._places, 0.0, line.length_m)
        return tuple(sorted(
            (float(s), light.name) for (s, n), light in zip(feet, self._lights, strict=True)
            if abs(n) <= ASIDE_M and 0.0 < s < line.length_m))

    def leave_out(self, row: Iterable[tuple[float, str]], s_m: float) -> None:
        """Give up the lights under the sensor of a robot that drives round an obstacle there."""
        sensor_m = s_m + SENSOR_FORWARD_M
        out = tuple(name for at_m, name in row if abs(at_m - sensor_m) <= FIT_RADIUS_M
                    and name not in self.judged and name not in self.kept.given_up)
        if out:
            self.kept = replace(self.kept, given_up=(*self.kept.given_up, *out))

    def is_complete(self, row: Iterable[tuple[float, str]]) -> bool:
        """Whether every light of a row is measured, or given up."""
        done = self.judged.union(self.kept.given_up)
        return all(name in done for _, name in row)

    def detour(self, row: Iterable[tuple[float, str]], s_m: float, *, ended: bool) -> Detour | None:
        """Return where to go back to, if a light was passed that has no measurement.

        Nothing before the Mission Manager was heard: it may have lights that are not kept here.

        Args:
            row: lights of the row, from `on_row`.
            s_m: arc length of the robot on the row, driving forward.
            ended: the row is at its end: also lights that are not passed by the full distance.
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
            # Turned forward again there, the sensor has the whole of the pass before it.
            to_s_m = at_m - FIT_RADIUS_M - SENSOR_FORWARD_M - ROOM_M
            return Detour(name, max(to_s_m, 0.0))
        return None


class RowInspection:
    """Holds inspection and ledger to the row that is driven; one mission at a time.

    Args:
        lights: of the airport.
        goes_back: whether the robot drives back for a light that it has missed.

    Attributes:
        inspection: measures.
        ledger: who knows of which measurement.
        is_incomplete: the row's end is reached and a light of it is neither measured nor given up.
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

    def hear(self, status: MissionStatus) -> None:
        """Take note of which lights the Mission Manager has, to go back for none of them."""
        if self._goes_back:
            self.ledger.hear(status)
            self.inspection.judged |= self.ledger.judged

    def begin(self, route: Route, row: LightRow | None) -> None:
        """Take note of another route, and of the row along it that is driven now, if one is."""
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
        """Return the new measurements; once each, to be kept before they are sent."""
        return [found for found in self.inspection.take(ended=arrived)
                if self.ledger.add(found, now_s)]

    def look_back(self, row: LightRow, *, arrived: bool) -> str:
        """Send the robot back for a light that it passed without a measurement.

        Args:
            row: what it follows.
            arrived: it is at the row's end, and about to leave it.

        Returns:
            The light's name if it turns round now, or "".
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
        # Without a word from the Mission Manager it is not known whether a light is missing.
        self.is_incomplete = arrived and not self.ledger.is_complete(self._row)
        return detour.light if detour is not None else ""

    def to_send_again(self, now_s: float) -> list[LightMeasurement]:
        """Return what the Mission Manager should have and does not show."""
        return self.ledger.to_send_again(now_s) if self._goes_back else []

    @property
    def missed(self) -> tuple[str, ...]:
        """The lights along all ways to this goal that were not measured."""
        return tuple(name for name in self._due if name not in self.inspection.judged)
