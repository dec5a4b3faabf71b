"""The inspection report of a run: one self-contained HTML page, and the same as JSON.

The page needs nothing but itself: style and map are inline, there is no script, it can be printed
and mailed. All text that came over the bus is escaped.
"""

from __future__ import annotations

import math
import os
import re
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jinja2
import msgspec

from rampart.sim.osmosis.clearance import EXACT_BELOW_M
from rampart.sim.osmosis.report_record import Interval, LightResult, RunRecord, RunRecorder

__all__ = ["RunRecord", "RunRecorder", "Written", "in_words", "render", "try_report",
           "write_report"]

BELIEVED_APART_M = 1.0
"""Where localization reported the robot is drawn too if it was this far from the truth."""

_LANES = {
    "injection": "Injected", "down": "Node down", "detection": "Detected",
    "recovery": "Recovery", "stop": "Stopped",
}
_TICKS = (1, 2, 5, 10, 20, 30, 60, 120, 300, 600, 1200, 3600)


def write_report(run: RunRecord, directory: str | Path) -> tuple[Path, Path]:
    """Write `inspection-RUN.html` and `.json` into a directory, which is made if need be.

    Both appear complete or not at all.

    Returns:
        The paths of the HTML and the JSON file.

    Raises:
        OSError: the directory cannot be written.
    """
    html, data = _paths(run, directory)
    html.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(data, _as_json(run))
    write_atomically(html, render(run).encode())
    return html, data


class Written(NamedTuple):
    """What there is of a report, and in one line why the rest is missing; "" if it is whole."""

    html: Path | None
    data: Path | None
    problem: str


def try_report(run: RunRecord, directory: str | Path) -> Written:
    """Write as much of a report as can be written; whatever goes wrong is told, not raised."""
    problems: dict[str, list[str]] = {}

    def written(path: Path, content: Callable[[], bytes]) -> Path | None:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(path, content())
        except Exception as error:  # of disk, template or chart alike: the verdict stands
            problems.setdefault(in_words(error), []).append(path.name)
            return None
        return path

    html, data = _paths(run, directory)
    kept = written(data, lambda: _as_json(run))
    page = written(html, lambda: render(run).encode())
    return Written(page, kept, "; ".join(
        f"{' and '.join(names)} cannot be written to {html.parent}: {why}"
        for why, names in problems.items()))


def in_words(error: Exception) -> str:
    """Return an error in a few words, for a line that names the file."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return f"{type(error).__name__}: {' '.join(str(error).split())}".removesuffix(": ")


def _paths(run: RunRecord, directory: str | Path) -> tuple[Path, Path]:
    stem = "inspection-" + (re.sub(r"[^A-Za-z0-9._-]+", "-", run.run_id) or "run")
    return Path(directory, f"{stem}.html"), Path(directory, f"{stem}.json")


def _as_json(run: RunRecord) -> bytes:
    return msgspec.json.format(msgspec.json.encode(run), indent=2)


def write_atomically(path: Path, content: bytes) -> None:
    """Replace a file so that a reader sees the old or the new one, never a half.

    Raises:
        OSError: it cannot be written.
    """
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
            os.fchmod(file.fileno(), 0o644)
        Path(temporary).replace(path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


def render(run: RunRecord) -> str:
    """Return the HTML page."""
    template = environment().get_template("osmosis/report.html")
    x0, y0, x1, y1 = _bounds(run)
    measured = [light for light in run.lights if light.verdict != "not measured"]
    return template.render(
        run=run,
        view_box=f"{x0:g} {-y1:g} {x1 - x0:g} {y1 - y0:g}",
        track=points(run.track),
        believed=points(run.believed) if _apart(run) else "",
        rows=_rows(run.lights),
        counts={verdict: sum(light.verdict == verdict for light in run.lights)
                for verdict in ("ok", "dim", "out", "not measured")},
        measured=len(measured),
        lanes=_lanes(run),
        ticks=_ticks(run.duration_s),
        headline=headline(run),
    )


def environment() -> jinja2.Environment:
    """Return what all reports are rendered with: pages of `sim/`, all text escaped."""
    made = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parents[1]), autoescape=True,
        undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    made.filters.update(clock=clock, clearance=clearance)
    return made


def headline(run: RunRecord) -> str:
    """Return the result of the run in one sentence."""
    faulty = [light.name for light in run.lights if light.verdict in ("dim", "out")]
    missing = sum(light.verdict == "not measured" for light in run.lights)
    if run.safety == "unsafe":
        return "The robot was not safe in this run."
    if run.safety == "not known":
        return "No ground truth ever came: neither mission nor safety can be judged."
    if run.mission == "fail":
        return "The mission was not completed; the robot stayed safe."
    if not run.lights:
        return "The mission was completed. This airport has no lights to inspect."
    parts = [f"{len(faulty)} of {len(run.lights)} lights need attention: {', '.join(faulty)}"
             if faulty else "no light needs attention"]
    if missing:
        parts.append(f"{missing} {'was' if missing == 1 else 'were'} not on the way")
    return f"The mission was completed; {'; '.join(parts)}."


def clock(seconds: float | None) -> str:
    """Return simulated seconds as minutes:seconds."""
    if seconds is None or not math.isfinite(seconds):
        return "–"  # noqa: RUF001 - typography for people
    minutes, rest = divmod(round(seconds, 1), 60)
    return f"{int(minutes)}:{rest:04.1f}"


def clearance(value: float | None) -> str:
    """Return a clearance for people; above `EXACT_BELOW_M` the simulator knows only a bound."""
    if value is None:
        return "–"  # noqa: RUF001
    return f"{EXACT_BELOW_M:g} m or more" if value >= EXACT_BELOW_M else f"{value:.2f} m"


def _bounds(run: RunRecord) -> tuple[float, float, float, float]:
    """Return the airport's bounds, widened to the whole track: an unsafe robot may leave them."""
    x0, y0, x1, y1 = run.airport.bounds_m
    xs = [p[1] for p in run.track]
    ys = [p[2] for p in run.track]
    return (min([x0, *(x - 2 for x in xs)]), min([y0, *(y - 2 for y in ys)]),
            max([x1, *(x + 2 for x in xs)]), max([y1, *(y + 2 for y in ys)]))


def points(track: Sequence[tuple[float, float, float]]) -> str:
    """Return a track, (t, x, y) each, as the points of an SVG line; y is turned over."""
    return " ".join(f"{x:g},{-y:g}" for _, x, y in track)


def _apart(run: RunRecord) -> bool:
    """Tell whether localization was somewhere far from all places where the robot really was."""
    real = [p[1:] for p in run.track]
    return bool(real) and any(
        min(math.dist(p[1:], q) for q in real) > BELIEVED_APART_M for p in run.believed[::3])


def _rows(lights: Sequence[LightResult]) -> dict[str, list[LightResult]]:
    rows: dict[str, list[LightResult]] = {}
    for light in lights:
        rows.setdefault(light.row, []).append(light)
    return rows


def _lanes(run: RunRecord) -> list[dict[str, Any]]:
    """Return the timeline's lanes: a name and its bars in percent of the run."""
    whole_s = max(run.duration_s, 1e-9)

    def bar(interval: Interval) -> dict[str, Any]:
        left = min(100.0, 100 * max(interval.from_s, 0) / whole_s)
        width = min(100.0 - left, 100 * (interval.to_s - interval.from_s) / whole_s)
        return {"left": round(left, 3), "width": round(max(width, 0), 3), "title": (
            f"{interval.name} {clock(interval.from_s)} to {clock(interval.to_s)}"
            + (f": {interval.reason}" if interval.reason else ""))}

    lanes: dict[tuple[str, str], dict[str, Any]] = {}
    for kind, label in _LANES.items():
        for interval in sorted((i for i in run.intervals if i.lane == kind),
                               key=lambda i: (i.name, i.from_s)):
            name = interval.reason if kind == "injection" else interval.name
            lane = lanes.setdefault((kind, name), {
                "kind": kind, "label": label, "name": name, "bars": []})
            lane["bars"].append(bar(interval))
    return list(lanes.values())


def _ticks(duration_s: float) -> list[dict[str, Any]]:
    step_s = next((t for t in _TICKS if duration_s / t <= 10), 7200)
    count = int(duration_s // step_s) if duration_s > 0 else 0
    return [{"left": round(100 * i * step_s / duration_s, 3), "text": clock(i * step_s)[:-2]}
            for i in range(count + 1) if duration_s > 0]
