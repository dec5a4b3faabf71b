"""The inspection report of a mission: one self-contained HTML page."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from markupsafe import Markup

from rampart.actors.osmosis.airport.drawing import AirportDrawing
from rampart.sim.osmosis.trial.record import LightResult, MissionRecord
from rampart.sim.osmosis.world import EXACT_BELOW_M
from rampart.sim.runs.record import RunRecord
from rampart.sim.runs.report import Moment, RunPictures, clock, environment, lanes_of, ticks_of

BELIEVED_APART_M = 1.0
"""Distance from the truth at which the track by localization is drawn too."""


def render(run: MissionRecord) -> str:
    """Return the HTML page."""
    pages = environment()
    pages.filters["clearance"] = clearance
    template = pages.get_template("osmosis/trial/report.html")
    x0, y0, x1, y1 = _bounds(run)
    unit = max(x1 - x0, y1 - y0) / _UNITS
    counts = Counter(light.verdict for light in run.lights)
    return template.render(
        run=run, headline=headline(run), view_box=f"{x0:g} {-y1:g} {x1 - x0:g} {y1 - y0:g}",
        unit=unit, dot=min(unit, max(unit / 4, 1.0)),
        track=points(run.track), believed=points(run.believed) if _apart(run) else "",
        rows=_rows(run.lights), counts=counts, measured=counts.total() - counts["not measured"],
        lanes=lanes_of(run), ticks=ticks_of(run.duration_s),
        marked=[("Goals reached", _reached(run))])


_UNITS = 90
"""Width of the map in units of a mark, so that marks have the same size on all maps."""


def headline(run: MissionRecord) -> str:
    """Return the result of the run in one sentence."""
    faulty = [light.name for light in run.lights if light.verdict in ("dim", "out")]
    missing = sum(light.verdict == "not measured" for light in run.lights)
    if run.safety == "unsafe":
        return "The robot was not safe in this run."
    if run.safety == "not known":
        return f"Neither mission nor safety can be judged: {run.reasons[0]}."
    if run.mission == "fail":
        return "The mission was not completed; the robot stayed safe."
    if not run.lights:
        return "The mission was completed. This airport has no lights to inspect."
    parts = [f"{len(faulty)} of {len(run.lights)} lights need attention: {', '.join(faulty)}"
             if faulty else "no light needs attention"]
    if missing:
        parts.append(f"{missing} {'was' if missing == 1 else 'were'} not on the route")
    return f"The mission was completed; {'; '.join(parts)}."


def clearance(value: float | None) -> str:
    """Return a clearance as text; above `EXACT_BELOW_M` only a bound is known."""
    if value is None:
        return "–"  # noqa: RUF001
    return f"{EXACT_BELOW_M:g} m or more" if value >= EXACT_BELOW_M else f"{value:.2f} m"


def _reached(run: MissionRecord) -> list[tuple[float, str]]:
    """Return positions on the timeline, percent, at which goals were reached, with labels."""
    return [(round(min(99.7, 100 * step.reached_s / run.duration_s), 3),
             f"step {number} at {clock(step.reached_s)}")
            for number, step in enumerate(run.steps, 1)
            if step.reached_s is not None and run.duration_s > 0]


def _bounds(run: MissionRecord) -> tuple[float, float, float, float]:
    """Return the airport's bounds, extended to the track, since an unsafe robot may leave them."""
    x0, y0, x1, y1 = run.airport.bounds_m
    return (
        min([x0, *(x - 2 for _, x, _ in run.track)]), min([y0, *(y - 2 for _, _, y in run.track)]),
        max([x1, *(x + 2 for _, x, _ in run.track)]), max([y1, *(y + 2 for _, _, y in run.track)]))


def points(track: Sequence[tuple[float, float, float]]) -> str:
    """Return a track of (t, x, y) as the points of an SVG line; y is flipped."""
    return " ".join(f"{x:g},{-y:g}" for _, x, y in track)


def _apart(run: MissionRecord) -> bool:
    """Whether localization reported a position far from the whole track."""
    real = [p[1:] for p in run.track]
    return bool(real) and any(
        min(math.dist(p[1:], q) for q in real) > BELIEVED_APART_M for p in run.believed[::3])


def _rows(lights: Sequence[LightResult]) -> dict[str, list[LightResult]]:
    rows: dict[str, list[LightResult]] = {}
    for light in lights:
        rows.setdefault(light.row, []).append(light)
    return rows


_CLOSE_UP_M = 9.0
_ASPECT = 1.75
_ROUND_TRACK_M = 4.0


class RunMaps(RunPictures):
    """Draws the true track on the airport."""

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
        """Return the distinct airports."""
        return self._render("run_airports.html", airports=self._airports)

    def picture(self, record: RunRecord, key: str, title: str, marks: Sequence[Moment]) -> Markup:
        """Return map and close-up of a run; nothing without a track."""
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
    """Return left, bottom, width and height, m, of a map of the track and the goals."""
    xs = [p[1] for p in record.track] + [goal.x_m for goal in record.steps]
    ys = [p[2] for p in record.track] + [goal.y_m for goal in record.steps]
    x0, x1 = min(xs) - _ROUND_TRACK_M, max(xs) + _ROUND_TRACK_M
    y0, y1 = min(ys) - _ROUND_TRACK_M, max(ys) + _ROUND_TRACK_M
    width = max(x1 - x0, (y1 - y0) * _ASPECT)
    height = width / _ASPECT
    return ((x0 + x1 - width) / 2, (y0 + y1 - height) / 2, width, height)


def _place(record: MissionRecord, at_s: float) -> tuple[float, float]:
    """Return the position on the track at a time, m."""
    before = [p for p in record.track if p[0] <= at_s] or record.track[:1]
    return before[-1][1:]
