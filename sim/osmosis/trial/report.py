"""The inspection report of a mission: one self-contained HTML page."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence

from rampart.sim.osmosis.trial.record import LightResult, MissionRecord
from rampart.sim.osmosis.world import EXACT_BELOW_M
from rampart.sim.runs.report import clock, environment, lanes_of, ticks_of

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
