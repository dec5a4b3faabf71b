"""The report of a run: a page from templates, with a timeline, written whole or not at all.

A page is self-contained: style and pictures are inline, and it has no script. So it can be printed
and mailed. All text from the bus is escaped.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import msgspec

from rampart.files.writing import replace_file
from rampart.sim.runs.record import Interval, RunRecord

if TYPE_CHECKING:
    import jinja2

_LANES = {"injection": "Injected", "down": "Node down", "detection": "Detected",
          "recovery": "Recovery", "stop": "Stopped"}
_TICKS = (1, 2, 5, 10, 20, 30, 60, 120, 300, 600, 1200, 3600)

NONE, MINUS = "–", "−"  # noqa: RUF001 - typography for people


class Written(NamedTuple):
    """The files of a report, and in one line why a file is missing; "" if none is."""

    html: Path | None
    data: Path | None
    problem: str


def try_report(run: RunRecord, render: Callable[[Any], str], directory: str | Path) -> Written:
    """Write `inspection-RUN.html` and `.json` to a directory, which is made if necessary.

    Each file is complete or missing. Errors are reported, not raised.

    Args:
        run: The record.
        render: Returns the page of a record.
        directory: Directory of the report.
    """
    problems: dict[str, list[str]] = {}

    def written(path: Path, content: Callable[[], bytes]) -> Path | None:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            replace_file(path, content(), 0o644)
        except Exception as error:  # of disk, template or chart alike: the verdict stands
            problems.setdefault(in_words(error), []).append(path.name)
            return None
        return path

    stem = "inspection-" + (re.sub(r"[^A-Za-z0-9._-]+", "-", run.run_id) or "run")
    html, data = Path(directory, f"{stem}.html"), Path(directory, f"{stem}.json")
    kept = written(data, lambda: msgspec.json.format(msgspec.json.encode(run), indent=2))
    page = written(html, lambda: render(run).encode())
    return Written(page, kept, "; ".join(
        f"{' and '.join(names)} cannot be written to {html.parent}: {why}"
        for why, names in problems.items()))


def render(run: RunRecord, title: str, margins: Sequence[tuple[str, str]] = ()) -> str:
    """Return the page of a run of any system.

    Args:
        run: The record.
        title: Title of the system.
        margins: Heading and text of each smallest margin.
    """
    return environment().get_template("runs/report.html").render(
        run=run, title=title, margins=margins, headline=_headline(run), lanes=lanes_of(run),
        ticks=ticks_of(run.duration_s), plots=plots_of(run))


def _headline(run: RunRecord) -> str:
    """Return the result of the run in a sentence."""
    if run.mission is None:
        return "This run had no judge."
    if run.safety == "unsafe":
        return "The system was not safe in this run."
    if run.safety == "not known":
        return f"Safety cannot be judged: {'; '.join(run.reasons) or 'no message shows it'}."
    return ("The task was done, and the system was safe." if run.mission == "success"
            else "The task was not done; the system was safe.")


def in_words(error: Exception) -> str:
    """Return the text of an error for a line that names the file."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return f"{type(error).__name__}: {' '.join(str(error).split())}".removesuffix(": ")


def environment() -> jinja2.Environment:
    """Return the environment of all reports: templates in `sim/`, all text escaped."""
    import jinja2  # noqa: PLC0415 not needed before the end of a run

    made = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parents[1]), autoescape=True,
        undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    made.filters.update(clock=clock)
    return made


def margin_text(value: float | None, unit: str, exact_below: float | None) -> str:
    """Return a margin; from `exact_below` on (None: never) it is a lower bound."""
    if value is None or not math.isfinite(value):
        return NONE
    if exact_below is not None and value >= exact_below:
        return f"≥ {exact_below:g} {unit}"
    return f"{value:.2f} {unit}".replace("-", MINUS)


def clock(seconds: float | None) -> str:
    """Return simulated seconds as minutes:seconds."""
    if seconds is None or not math.isfinite(seconds):
        return NONE
    minutes, rest = divmod(abs(round(seconds, 1)), 60)
    sign = MINUS if round(seconds, 1) < 0 else ""  # before the start
    return f"{sign}{int(minutes)}:{rest:04.1f}"


def lanes_of(run: RunRecord) -> list[dict[str, Any]]:
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


def plots_of(run: RunRecord) -> list[dict[str, Any]]:
    """Return the curves of a run by plot: its ends, and each curve in a box of 600 x 120."""
    plots = []
    for title, curves in groupby(run.curves, key=lambda curve: curve.plot):
        drawn = list(curves)
        values = [value for curve in drawn for _, value in curve.points]
        low, high = min(values), max(values)
        x, y = 600 / max(run.duration_s, 1e-9), 116 / ((high - low) or 1.0)
        plots.append({"title": title, "low": f"{low:.4g}", "high": f"{high:.4g}", "lines": [
            {"field": curve.field, "points": " ".join(
                f"{t * x:.1f},{118 - (value - low) * y:.1f}" for t, value in curve.points)}
            for curve in drawn]})
    return plots


def ticks_of(duration_s: float) -> list[dict[str, Any]]:
    """Return the timeline's ticks: place in percent of the run, and text."""
    if not duration_s > 0:
        return []
    step_s = next((t for t in _TICKS if duration_s / t <= 10), 7200)
    return [{"left": round(100 * i * step_s / duration_s, 3), "text": clock(i * step_s)[:-2]}
            for i in range(int(duration_s // step_s) + 1)]
