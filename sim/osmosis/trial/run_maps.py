"""Maps of missions, for the report of a campaign: the track with its moments, and a close-up."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from markupsafe import Markup

from rampart.actors.osmosis.airport.drawing import AirportDrawing
from rampart.sim.osmosis.trial.record import MissionRecord
from rampart.sim.osmosis.trial.report import points
from rampart.sim.runs.report import Moment, RunPictures
from rampart.sim.runs.record import RunRecord
from rampart.sim.runs.report import environment

_CLOSE_UP_M = 9.0
_ASPECT = 1.75
_ROUND_TRACK_M = 4.0


class RunMaps(RunPictures):
    """Draws the way that the robot really drove, on its airport."""

    style = Markup(Path(__file__).with_name("run_maps.css").read_text(encoding="utf-8"))  # noqa: S704 our own
    words = ("The close-up shows the first unsafe moment, else that of the smallest margin. "
             "Circles are the goals, red if not reached; filled ones obstacles; hatched ground is "
             "prohibited.")

    def __init__(self, records: Sequence[MissionRecord]) -> None:
        super().__init__(records)
        self._airports: list[AirportDrawing] = []
        for record in records:
            if record.airport not in self._airports:
                self._airports.append(record.airport)
        self._pages = environment()

    def definitions(self) -> Markup:
        """Return the airports, each once."""
        return self._render("run_airports.html", airports=self._airports)

    def picture(self, record: RunRecord, key: str, title: str, marks: Sequence[Moment]) -> Markup:
        """Return map and close-up of a run; nothing if the robot was never seen."""
        if not isinstance(record, MissionRecord) or not record.track:
            return Markup("")
        placed = [(*mark, *_place(record, mark.at_s)) for mark in marks]
        _, _, _, x_m, y_m = next((mark for kind in ("unsafe", "narrow")
                                  for mark in placed if mark[1] == kind), placed[0])
        views = [_view(record), (x_m - _CLOSE_UP_M / 2, y_m - _CLOSE_UP_M / 2,
                                 _CLOSE_UP_M, _CLOSE_UP_M)]
        return self._render(
            "run_map.html", run=record, key=key, title=title, marks=placed, views=views,
            line=points(record.track), airport=self._airports.index(record.airport))

    def _render(self, name: str, **values: object) -> Markup:
        return Markup(self._pages.get_template(f"osmosis/trial/{name}").render(values))  # noqa: S704 it escapes


def _view(record: MissionRecord) -> tuple[float, float, float, float]:
    """Return left, bottom, width and height of the map, in metres: the track and its goals."""
    xs = [p[1] for p in record.track] + [goal.x_m for goal in record.steps]
    ys = [p[2] for p in record.track] + [goal.y_m for goal in record.steps]
    x0, x1 = min(xs) - _ROUND_TRACK_M, max(xs) + _ROUND_TRACK_M
    y0, y1 = min(ys) - _ROUND_TRACK_M, max(ys) + _ROUND_TRACK_M
    width = max(x1 - x0, (y1 - y0) * _ASPECT)
    height = width / _ASPECT
    return ((x0 + x1 - width) / 2, (y0 + y1 - height) / 2, width, height)


def _place(record: MissionRecord, at_s: float) -> tuple[float, float]:
    """Return where the robot was, to the step of the track, m."""
    before = [p for p in record.track if p[0] <= at_s] or record.track[:1]
    return before[-1][1:]
