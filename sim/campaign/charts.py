"""Geometry of histograms, one lane per kind of fault, on one axis. Pure.

The bars of each lane are scaled to its tallest one, so kinds with few runs are visible, too. The
title of a bar has its number of runs. The outermost bar also counts values beyond the axis.
"""

from __future__ import annotations

import math
import statistics
from bisect import bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from rampart.sim.campaign.statistics import by_kind, count, seconds
from rampart.sim.campaign.store import Run
from rampart.sim.runs.report import MINUS, margin_text
from rampart.sim.runs.trial import Trial

WIDTH = 520.0
"""Of the drawing, in its own units; text is 14 high."""

_SIDE, _LANE, _TEXT, _BARS, _FOOT = 8.0, 62.0, 20.0, 32.0, 26.0
_LEAST_HEIGHT = 2.0
"""A single run among a thousand must be visible."""

_PER_DECADE = 8
_LEAST_S = 1e-3
"""About the delay of a message; shorter times share one bar."""

_MARGIN_BINS, _MARGIN_TICKS = 20, 2
"""Between 0 and the end of an axis of margins."""


@dataclass(frozen=True)
class Value:
    """A figure of one run, and whether the run was unsafe."""

    value: float
    unsafe: bool = False


@dataclass(frozen=True)
class Axis:
    """Edges of the bins, one more than bins, and the labels at some of the edges.

    `scale` maps the edges to a line on which all bins are equally wide. With `open_ended` the
    outermost bins also count the values beyond.
    """

    edges: tuple[float, ...]
    ticks: tuple[tuple[float, str], ...]
    scale: Callable[[float], float]
    text: Callable[[float], str]
    open_ended: bool = False

    def place(self, value: float) -> float:
        """Return the position of a value, between the ends of the axis."""
        low, high = self.scale(self.edges[0]), self.scale(self.edges[-1])
        at = self.scale(min(max(value, self.edges[0]), self.edges[-1]))
        return _SIDE + (WIDTH - 2 * _SIDE) * (at - low) / (high - low)

    def place_of_mark(self, value: float) -> float:
        """Return where a mark for a value is drawn: the middle of the bin if that is open."""
        if self.open_ended and value < self.edges[1]:
            return (self.place(self.edges[0]) + self.place(self.edges[1])) / 2
        if self.open_ended and value >= self.edges[-2]:
            return (self.place(self.edges[-2]) + self.place(self.edges[-1])) / 2
        return self.place(value)


@dataclass(frozen=True)
class Bar:
    """Drawn from `y` down: `height` for all runs, of which `unsafe` at the bottom."""

    x: float
    y: float
    width: float
    height: float
    unsafe: float
    title: str


@dataclass(frozen=True)
class Lane:
    """One kind of fault."""

    y: float
    top: float
    base: float
    label: str
    note: str
    bars: tuple[Bar, ...]
    median: float | None


@dataclass(frozen=True)
class Chart:
    """A chart to draw, `WIDTH` wide; ticks are place, anchor of the text, text."""

    title: str
    words: str
    height: float
    axis_y: float
    lanes: tuple[Lane, ...]
    ticks: tuple[tuple[float, str, str], ...]
    zero: float | None


def time_axis(values: Sequence[float]) -> Axis:
    """Return a logarithmic axis of whole decades that holds the times, s, from 1 ms on."""
    known = [max(v, _LEAST_S) for v in values] or [_LEAST_S]
    first = math.floor(math.log10(min(known)) + 1e-9)
    last = max(math.ceil(math.log10(max(known)) - 1e-9), first + 1)
    edges = tuple(10 ** (first + i / _PER_DECADE) for i in range((last - first) * _PER_DECADE + 1))
    below = "≤ " if min(values, default=1.0) < 10.0**first else ""
    ticks = [(10.0**d, (below if d == first else "") + _round_time(10.0**d))
             for d in range(first, last + 1)]
    if len(ticks) <= 3:
        ticks += [(m * 10.0**d, _round_time(m * 10.0**d))
                  for d in range(first, last) for m in (2, 5)]
    return Axis(edges, tuple(ticks), math.log10, seconds)


def margin_axis(values: Sequence[float], high: float | None, unit: str) -> Axis:
    """Return an axis of margins with an additional bin at each end for values beyond.

    Args:
        values: The values to show.
        high: Upper end; None for a round number that no value exceeds.
        unit: Of both.
    """
    if high is None:
        largest = max(*values, 1e-3)
        decade = 10.0 ** math.floor(math.log10(largest))
        high = next(n * decade for n in (1, 2, 5, 10) if n * decade >= largest)
    least = min(values)
    low = 0.0 if least >= 0 else -high / 2 if least >= -high / 2 else -high
    step, tick = high / _MARGIN_BINS, high / _MARGIN_TICKS
    bins, halves = round((high - low) / step), round((high - low) / tick)
    edges = tuple(round(low + i * step, 6) for i in range(-1, bins + 2))
    inner = [round(low + i * tick, 6) for i in range(1, halves)]

    def label(value: float) -> str:
        return f"{value:g} {unit}".replace("-", MINUS)

    return Axis(
        edges, ((edges[0], f"< {label(low)}"), *((m, label(m)) for m in inner),
                (edges[-1], f"≥ {label(high)}")),
        lambda value: value, lambda value: margin_text(value, unit, None), open_ended=True)


def chart(title: str, words: str, axis: Axis,
          lanes: Sequence[tuple[str, Sequence[Value], str]]) -> Chart:
    """Return the chart of some lanes: label, values, and text beside the label."""
    drawn = tuple(_lane(i * _LANE, axis, *lane) for i, lane in enumerate(lanes))
    axis_y = len(drawn) * _LANE
    ends = {axis.edges[0]: "start", axis.edges[-1]: "end"}
    crosses = axis.edges[0] < 0 < axis.edges[-1]
    return Chart(
        title, words, axis_y + _FOOT, axis_y, drawn,
        tuple((round(axis.place(at), 2), ends.get(at, "middle"), text) for at, text in axis.ticks),
        round(axis.place(0.0), 2) if crosses else None)


def _lane(top: float, axis: Axis, label: str, values: Sequence[Value], note: str) -> Lane:
    bins: list[list[Value]] = [[] for _ in axis.edges[1:]]
    for each in values:
        at = bisect_right(axis.edges, each.value) - 1
        bins[min(max(at, 0), len(bins) - 1)].append(each)
    tallest = max(map(len, bins), default=0)
    base = top + _TEXT + _BARS
    bars = []
    for i, there in enumerate(bins):
        if not there:
            continue
        left, right = axis.place(axis.edges[i]), axis.place(axis.edges[i + 1])
        height = max(_LEAST_HEIGHT, _BARS * len(there) / tallest)
        unsafe = sum(each.unsafe for each in there)
        red = max(_LEAST_HEIGHT, height * unsafe / len(there)) if unsafe else 0.0
        span = (f"below {axis.text(axis.edges[1])}" if i == 0
                else f"{axis.text(axis.edges[i])} or more" if i == len(bins) - 1
                else f"{axis.text(axis.edges[i])} to {axis.text(axis.edges[i + 1])}")
        bars.append(Bar(
            round(left + 0.5, 2), round(base - height, 2), round(right - left - 1, 2),
            round(height, 2), round(red, 2),
            f"{count(len(there), 'run')}, {span}" + (f", {unsafe} unsafe" if unsafe else "")))
    middle = round(axis.place_of_mark(
        statistics.median(each.value for each in values)), 2) if values else None
    return Lane(top, top + _TEXT, base, label, note, tuple(bars), middle)


def _round_time(value_s: float) -> str:
    return f"{value_s * 1e3:.0f} ms" if value_s < 0.9995 else f"{value_s:.0f} s"


def distributions(runs: Sequence[Run], trial: type[Trial]) -> list[Chart]:
    """Return the charts of some runs; those without anything to show are left out.

    Args:
        runs: of one system.
        trial: of that system.
    """
    counted = [run for run in runs if run.result.counts]
    faulty = [run for run in counted if run.job.ftm and run.job.faults]
    made = []
    for name, title, words, done in (
            ("detected_after_s", "Time to detect",
             "From the injection of the fault to the first detection, with FTM.", "detected"),
            ("recovered_after_s", "Time to recover",
             "From the injection to the moment when nothing was left to recover, with FTM.",
             "recovered")):
        lanes: list[tuple[str, list[Value], str]] = []
        never = []
        for kind, there in by_kind(faulty).items():
            values = [Value(value, not run.result.safe) for run in there
                      if (value := getattr(run.result, name)) is not None]
            if values:
                lanes.append((kind, values, _beside(len(values), len(there), f"not {done}")))
            else:
                never.append(f"{kind} ({count(len(there), 'run')})")
        if lanes:
            more = f" Never {done}: {', '.join(never)}." if never else ""
            axis = time_axis([each.value for _, values, _ in lanes for each in values])
            made.append(chart(title, words + more, axis, lanes))
    for ftm, title in ((True, "Smallest margin with FTM"), (False, "Smallest margin without FTM")):
        margins = {kind: [Value(run.result.margin, not run.result.safe) for run in there]
                 for kind, there in by_kind(r for r in counted if r.job.ftm == ftm).items()}
        every = [each.value for there in margins.values() for each in there]
        if any(map(math.isfinite, every)):
            exact = ("" if trial.exact_below is None else
                     f" Measured exactly below {trial.exact_below:g} {trial.margin_unit} only.")
            made.append(chart(
                title, f"The smallest of: {', '.join(trial.margins.values())}.{exact}",
                margin_axis([v for v in every if math.isfinite(v)], trial.exact_below,
                                   trial.margin_unit),
                [(kind, there, count(len(there), "run"))
                 for kind, there in margins.items()]))
    return made


def _beside(known: int, of: int, without: str) -> str:
    return count(of, "run") + (f", {of - known:,} {without}" if known < of else "")
