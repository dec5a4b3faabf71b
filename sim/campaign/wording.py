"""Figures of a campaign as people read them: digits that mean something, and a unit. Pure."""

from __future__ import annotations

import math

from rampart.sim.campaign.statistics import Rate
from rampart.sim.runs.report import NONE


def percent(share: float) -> str:
    """Return a share in percent without the sign; only what is 0 or 1 reads "0" or "100"."""
    if math.isnan(share):
        return NONE
    if share in (0.0, 1.0):
        return f"{100 * share:.0f}"
    for digits in (1, 2):
        text = f"{100 * share:.{digits}f}"
        if 0 < float(text) < 100:
            return text
    return "< 0.01" if share < 0.5 else "> 99.99"


def interval(found: Rate) -> str:
    """Return the confidence interval of a share, or nothing if there were no runs."""
    return f"{percent(found.low)} to {percent(found.high)} %" if found.of else ""


def seconds(value: float | None) -> str:
    """Return a time with three digits: milliseconds below a second."""
    if value is None:
        return NONE
    if value < 0.9995:
        return f"{value * 1e3:.0f} ms"
    return f"{value:.{2 if value < 9.995 else 1 if value < 99.95 else 0}f} s"


def count(number: int, what: str) -> str:
    """Return "1 run", "2 runs", "1,200 runs"."""
    return f"{number:,} {what}{'' if number == 1 else 's'}"
