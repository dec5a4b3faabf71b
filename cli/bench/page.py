"""What was measured as tables and plots: for the terminal, and as one HTML page. Pure.

A plot is lanes on one logarithmic axis: a dot for each sample, a line from the 5th to the 95th
percentile, a bar at the median. It is part of the page, and an SVG file of its own.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from markupsafe import Markup

from rampart.cli.bench.figures import Figures, Floor, Killed, Size, Spread
from rampart.cli.bench.peers import ACTOR, OURS
from rampart.cli.bench.size import TARGET as SIZE_TARGET
from rampart.cli.bench.systems import BESIDES
from rampart.cli.output import rendered
from rampart.sim.runs.report import NONE

WIDTH = 640.0
"""Of a plot, in its own units; its text is 14 of them high."""

DORA_TARGET = 10.0
"""The peer dora is to take at least so many times as long as Rampart's actor."""

_SIDE, _LANE, _TEXT, _LINE, _FOOT = 10.0, 44.0, 16.0, 29.0, 26.0
_STEPS = (1, 2, 5)


class Lane(NamedTuple):
    """A row of a plot: its label, what is said beside it, samples, and whether it is Rampart's."""

    label: str
    samples: Sequence[float]
    spread: Spread
    ours: bool = False


class Drawn(NamedTuple):
    """A lane as it is drawn."""

    y: float
    line_y: float
    label: str
    note: str
    dots: tuple[float, ...]
    low: float
    high: float
    median: float
    ours: bool


class Plot(NamedTuple):
    """A plot as it is drawn; ticks are place, anchor of the text, text."""

    title: str
    height: float
    axis_y: float
    lanes: tuple[Drawn, ...]
    ticks: tuple[tuple[float, str, str], ...]


class Section(NamedTuple):
    """A part of the benchmark as it is shown; the plot is SVG, None if nothing was measured."""

    name: str
    title: str
    words: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    plot: Plot | None


def ticks(low: float, high: float) -> list[float]:
    """Return round numbers that enclose two others, and those between: 1, 2, 5, 10, 20, ..."""
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    steps = [step * 10.0**decade for decade in decades for step in _STEPS]
    first = max(i for i, step in enumerate(steps) if step <= low * (1 + 1e-9))
    last = min(i for i, step in enumerate(steps) if step >= high * (1 - 1e-9))
    return steps[first:max(last, first + 1) + 1]


def plot(title: str, lanes: Sequence[Lane], unit: str = "ms") -> Plot | None:
    """Return the plot of some lanes, None if there are none."""
    if not lanes:
        return None
    every = [value for lane in lanes
             for value in (*lane.samples, lane.spread.low, lane.spread.high) if value > 0]
    marks = ticks(min(every), max(every))
    low, high = math.log10(marks[0]), math.log10(marks[-1])

    def place(value: float) -> float:
        share = (math.log10(max(value, marks[0])) - low) / (high - low)
        return round(_SIDE + share * (WIDTH - 2 * _SIDE), 1)

    drawn = tuple(Drawn(
        i * _LANE + _TEXT, i * _LANE + _LINE, lane.label, f"{number(lane.spread.median)} {unit}",
        tuple(map(place, lane.samples)), place(lane.spread.low), place(lane.spread.high),
        place(lane.spread.median), lane.ours) for i, lane in enumerate(lanes))
    axis_y = len(lanes) * _LANE
    anchors = {0: "start", len(marks) - 1: "end"}
    return Plot(title, axis_y + _FOOT, axis_y, drawn, tuple(
        (place(mark), anchors.get(i, "middle"), f"{mark:g} {unit}" if i == 0 else f"{mark:g}")
        for i, mark in enumerate(marks)))


def number(value: float | None) -> str:
    """Return a figure with three significant digits, a dash for none."""
    if value is None:
        return NONE
    return f"{value:.0f}" if abs(value) >= 99.95 else f"{value:.3g}"


def _median(of: Spread | None) -> str:
    return number(of.median if of else None)


def _range(of: Spread | None) -> str:
    return f"{number(of.low)} to {number(of.high)}" if of else NONE


def _kills(row: Killed) -> str:
    return f"{row.output_ms.n if row.output_ms else 0}" + (f"; {row.note}" if row.note else "")


def _outputs(rows: Sequence[Killed], ours: Sequence[str] = ()) -> list[Lane]:
    return [Lane(row.title if row.name in OURS or ours else row.name,
                 [kill.output for kill in row.kills if kill.output is not None],
                 row.output_ms, row.name in ours) for row in rows if row.output_ms]


def _peers(rows: Sequence[Killed]) -> Section:
    return Section(
        "peers", "The same node under other keepers",
        "One program, killed by SIGKILL in turn under each; what an independent process on the "
        "same bus hears. Milliseconds after the kill: the keeper says that the node is gone, the "
        "replacement runs its first line, its first valid output is heard (median, 5 to 95 %). "
        "Times: as long as Rampart's actor takes, round by round; dora's target is "
        f"{DORA_TARGET:g}.",
        ("kept alive by", "detected", "begun", "output", "5 to 95 %", "times", "5 to 95 %",
         "kills"),
        tuple((row.title, _median(row.detected_ms), _median(row.begun_ms), _median(row.output_ms),
               _range(row.output_ms), *(("", "") if row.name == ACTOR else
                                        (_median(row.times), _range(row.times))), _kills(row))
              for row in rows),
        plot("SIGKILL to the replacement's first output", _outputs(rows, tuple(OURS))))


def _beside(rows: Sequence[Floor]) -> list[Lane]:
    lanes = []
    for row in rows:
        if row.floor and row.unit == "ms":
            lanes.append(Lane(row.title, (), row.floor))
            if row.ours:
                lanes.append(Lane(row.against, (), row.ours, ours=True))
    return lanes


def _aim(row: Floor) -> str:
    return row.note or (f"at most {row.target:g}" if row.target else "")


def _floors(rows: Sequence[Floor]) -> Section:
    return Section(
        "floors", "What cannot be beaten",
        "Milliseconds, median (5 to 95 %), and how many times as long what is compared with it "
        "takes in the same run.",
        ("floor", "takes", "5 to 95 %", "compared with it", "takes", "5 to 95 %", "ratio",
         "target"),
        tuple((row.title, _median(row.floor), _range(row.floor), row.against, _median(row.ours),
               _range(row.ours), number(row.ratio), _aim(row)) for row in rows),
        plot("Floors, and what stands on them", _beside(rows)))


def _keys(rows: Sequence[Floor]) -> Section:
    return Section(
        "keys", "What keys cost",
        "Milliseconds, median (5 to 95 %), without keys and with them, in turn.",
        ("", "without", "5 to 95 %", "with keys", "5 to 95 %", "ratio", "target"),
        tuple((row.title, _median(row.floor), _range(row.floor), _median(row.ours),
               _range(row.ours), number(row.ratio), _aim(row)) for row in rows),
        plot("Without keys, and with them", _beside(rows)))


def _restart(rows: Sequence[Killed]) -> Section:
    return Section(
        "restart", "Nodes of a whole system",
        "Each killed by SIGKILL while the system works, in turn. Milliseconds until its death is "
        "known (a detection module or the supervisor), until the manager has decided on a recovery "
        "if it is the manager's, and until its replacement's first message on its fastest regular "
        "topic is heard.",
        ("node", "heard on", "detected", "5 to 95 %", "decided", "output", "5 to 95 %", "kills"),
        tuple((row.name, row.title, _median(row.detected_ms), _range(row.detected_ms),
               _median(row.decided_ms), _median(row.output_ms), _range(row.output_ms), _kills(row))
              for row in rows),
        plot("SIGKILL to the replacement's first output", _outputs(rows)))


def _size(rows: Sequence[Size]) -> Section:
    lanes = [Lane(f"{row.processes} processes", row.samples_ms, row.output_ms, ours=True)
             for row in rows if row.output_ms]
    return Section(
        "size", "Cost against size",
        f"Systems of so many processes, of which all but {BESIDES} publish at 20 Hz and hear two "
        "others. "
        "From the command until all run; memory of a process at the mean (PSS: what is shared is "
        "divided; USS: its own); cores that all take at rest; SIGKILL of a node until its "
        f"replacement is heard, against the smallest (target at most {SIZE_TARGET:g}).",
        ("processes", "start s", "PSS MB", "USS MB", "all MB", "cores", "back ms", "5 to 95 %",
         "times", ""),
        tuple((f"{row.processes}", number(row.start_s), number(row.pss_mb), number(row.uss_mb),
               number(row.total_mb), number(row.cores), _median(row.output_ms),
               _range(row.output_ms), number(row.times), row.note) for row in rows),
        plot("SIGKILL of a node until its replacement is heard", lanes))


def sections(figures: Figures) -> list[Section]:
    """Return the parts that were measured, in the sequence in which they are shown."""
    found = []
    if figures.peers is not None:
        found.append(_peers(figures.peers))
    if figures.floors is not None:
        found.append(_floors(figures.floors))
    if figures.restart is not None:
        found.append(_restart(figures.restart))
    if figures.size is not None:
        found.append(_size(figures.size))
    if figures.keys is not None:
        found.append(_keys(figures.keys))
    return found


def svg(drawn: Plot, *, alone: bool) -> str:
    """Return a plot as SVG; alone it brings its own colours, otherwise those of the page."""
    return rendered(Path(__file__).with_name("plot.svg.jinja"), escaped=True, plot=drawn,
                    width=WIDTH, side=_SIDE, alone=alone)


def html(figures: Figures) -> str:
    """Return the page; it needs nothing but itself."""
    import rampart.sim.runs  # noqa: PLC0415 whose style it shares

    shown = [(section, Markup(svg(section.plot, alone=False)) if section.plot else "")  # noqa: S704
             for section in sections(figures)]
    style = Path(rampart.sim.runs.__path__[0], "report.css").read_text(encoding="utf-8")
    return rendered(Path(__file__).with_name("report.html"), escaped=True, figures=figures,
                    sections=shown, style=Markup(style))  # noqa: S704 our own file
