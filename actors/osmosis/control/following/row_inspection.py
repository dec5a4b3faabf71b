"""The lights of the rows that Osmosis Control drives: what is measured, and what is missed.

`LightInspection` measures, `LightLedger` remembers who knows of it; here they are held to the row
that is being followed. Pure: no clock, no messages sent, no bus.
"""

from __future__ import annotations

from rampart.actors.osmosis.airport.model import Light
from rampart.actors.osmosis.control.following.light_inspection import LightInspection
from rampart.actors.osmosis.control.following.light_ledger import LightLedger
from rampart.actors.osmosis.control.following.light_row import LightRow
from rampart.actors.osmosis.control.polyline import Point, Polyline
from rampart.actors.osmosis.messages import LightMeasurement, MissionStatus, Mode, Route

_OVER_M = 0.5
"""A light this near to the row's line is one of the row."""


class RowInspection:
    """The lights of one mission at a time.

    Args:
        lights: of the airport.
        goes_back: whether the robot drives back for a light that it has missed.

    Attributes:
        ledger: who knows of which measurement.
        is_incomplete: the row's end is reached and a light of it is neither measured nor given up.
    """

    def __init__(self, lights: tuple[Light, ...], *, goes_back: bool) -> None:
        self._lights = lights
        self._goes_back = goes_back
        self._inspection = LightInspection(lights)
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
            self._inspection.judged |= self.ledger.judged

    def pose(self, stamp_s: float, x_m: float, y_m: float, yaw_rad: float) -> None:
        """Take a pose of `base_link` in `map`."""
        self._inspection.pose(stamp_s, x_m, y_m, yaw_rad)

    def sample(self, stamp_s: float, illuminance_lux: float) -> None:
        """Take a reading of the light sensor."""
        self._inspection.sample(stamp_s, illuminance_lux)

    def begin(self, route: Route, row: LightRow | None) -> None:
        """Take note of another route, and of the row along it that is driven now, if one is."""
        if route.mission_id != self._mission_id:
            self._mission_id = route.mission_id
            self.ledger.begin(route.mission_id)
            self._inspection = LightInspection(self._lights, judged=self.ledger.judged)
        goal = (route.mission_id, route.step, route.mode)
        if goal != self._goal:
            self._goal, self._due = goal, {}
        if route.mode is Mode.LIGHT_VERIFICATION and route.waypoints:
            self._due |= dict.fromkeys(
                light.name for light in lights_along(self._lights, route.waypoints))
        if row is not None:
            self._row = self.ledger.on_row(row.line)

    def measure(self, now_s: float, *, arrived: bool) -> list[LightMeasurement]:
        """Return the new measurements; once each, to be kept before they are sent."""
        return [found for found in self._inspection.take(ended=arrived)
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
        return tuple(name for name in self._due if name not in self._inspection.judged)


def lights_along(lights: tuple[Light, ...], waypoints: tuple[Point, ...]) -> tuple[Light, ...]:
    """Return the lights that a robot passes over which follows the waypoints."""
    line = Polyline(waypoints)
    feet = [(light, line.project(light.x_m, light.y_m)) for light in lights]
    return tuple(light for light, foot in feet
                 if 0.0 < foot.s_m < line.length_m and abs(foot.n_m) <= _OVER_M)
