"""Draws a soak: memory, descriptors and latencies over time, as a PNG and in an HTML page."""

from __future__ import annotations

import base64
import html
import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from PIL import Image, ImageDraw, ImageFont

from tests.whole.chaos_pairs import LAUNCHER
from tests.whole.soak_growth import Sample
from tests.whole.soak_summary import (
    DESCRIPTORS,
    OWN,
    SHARE,
    THREADS,
    Record,
    of_kind,
    of_role,
    totals,
)

WIDTH, PANEL, LEFT, RIGHT, TOP, GAP = 1100, 190, 76, 150, 40, 46
COLOURS = ("#1667c7", "#b3470f", "#0e713e", "#8a3ffc")
INK, RULE = "#17202a", "#dde3e9"

Points = list[tuple[float, float]]


class Panel(NamedTuple):
    """A title, whether its axis is logarithmic, and names with points, joined by lines or not."""

    title: str
    is_log: bool
    series: list[tuple[str, Points, bool]]


def _panels(records: Sequence[Record]) -> list[Panel]:
    def line(samples: list[Sample]) -> Points:
        return [(s.at_s / 60, s.value) for s in samples]

    begun = {r["mission"]: r["at_s"] for r in of_kind(records, "begin")}

    def late(what: str, nodes: bool) -> Points:
        return [((begun[r["mission"]] + r["into_s"]) / 60, 1e3 * max(r[what], 1e-3))
                for r in of_kind(records, "latency")
                if ("affected" not in r) is nodes and r[what] is not None]

    return [
        Panel("memory of all processes, MB", False, [
            ("shares (PSS)", line(totals(records, SHARE, 1e-3)), True),
            ("their own (USS)", line(totals(records, OWN, 1e-3)), True)]),
        Panel("memory of the launcher, MB", False, [
            ("its own (USS)", line(of_role(records, [LAUNCHER], OWN, 1e-3)), True)]),
        Panel("descriptors and threads of all processes", False, [
            ("descriptors", line(totals(records, DESCRIPTORS, 1.0)), True),
            ("threads", line(totals(records, THREADS, 1.0)), True)]),
        Panel("after a fault, ms", True, [
            ("node known down", late("detected_s", True), False),
            ("node up again", late("over_s", True), False),
            ("module detects", late("detected_s", False), False)])]


def draw(records: Sequence[Record]) -> Image.Image:
    """Return the plot."""
    panels = _panels(records)
    image = Image.new("RGB", (WIDTH, TOP + len(panels) * (PANEL + GAP) + 10), "#ffffff")
    to = ImageDraw.Draw(image)
    end = max([x for panel in panels for _, points, _ in panel.series for x, _ in points],
              default=1.0) or 1.0
    missions = [r["at_s"] / 60 for r in of_kind(records, "begin")]
    for i, panel in enumerate(panels):
        _panel(to, TOP + i * (PANEL + GAP), panel, end, missions)
    to.text((LEFT, image.height - 20), "minutes of the soak; grey lines: a mission begins",
            fill=INK, font=ImageFont.load_default(13))
    return image


def _panel(to: ImageDraw.ImageDraw, top: int, panel: Panel, end: float,
           missions: Sequence[float]) -> None:
    title, is_log, series = panel
    font = ImageFont.load_default(13)
    values = [y for _, points, _ in series for _, y in points] or [0.0, 1.0]
    low, high = _ends(values, is_log)

    def at(x: float, y: float) -> tuple[float, float]:
        part = ((math.log(y / low) / math.log(high / low)) if is_log
                else (y - low) / (high - low))
        return LEFT + x / end * (WIDTH - LEFT - RIGHT), top + PANEL * (1 - part)

    to.text((LEFT, top - 20), title, fill=INK, font=ImageFont.load_default(15))
    for y in _ticks(low, high, is_log):
        (x0, py), (x1, _) = at(0, y), at(end, y)
        to.line((x0, py, x1, py), fill=RULE)
        to.text((x0 - 8, py), f"{y:g}", fill=INK, font=font, anchor="rm")
    for x in missions:
        to.line((at(x, low)[0], top, at(x, low)[0], top + PANEL), fill="#b9c2cb")
    for x in _ticks(0.0, end, False):
        to.text((at(x, low)[0], top + PANEL + 4), f"{x:g}", fill=INK, font=font, anchor="ma")
    for k, (name, points, joined) in enumerate(series):
        for some in _missions(points, missions) if joined else ():
            to.line([at(x, y) for x, y in some], fill=COLOURS[k], width=2)
        for x, y in () if joined else (at(x, y) for x, y in points):
            to.ellipse((x - 2, y - 2, x + 2, y + 2), fill=COLOURS[k])
        y = top + 18 * k + 8
        to.rectangle((WIDTH - RIGHT + 10, y - 4, WIDTH - RIGHT + 18, y + 4), fill=COLOURS[k])
        to.text((WIDTH - RIGHT + 24, y), name, fill=COLOURS[k], font=font, anchor="lm")


def _missions(points: Points, begun: Sequence[float]) -> list[Points]:
    """Return points mission by mission: between two there is nothing."""
    return [some for a, b in zip(begun, (*begun[1:], math.inf), strict=True)
            if len(some := [p for p in points if a <= p[0] < b]) > 1]


def _ends(values: Sequence[float], is_log: bool) -> tuple[float, float]:
    low, high = min(values), max(values)
    if is_log:
        return 10 ** math.floor(math.log10(low)), 10 ** math.ceil(math.log10(high * 1.001))
    return 0.0, high * 1.15 or 1.0


def _ticks(low: float, high: float, is_log: bool) -> list[float]:
    if is_log:
        return [10.0 ** k for k in range(round(math.log10(low)), round(math.log10(high)) + 1)]
    step = 10 ** math.floor(math.log10((high - low) / 3))
    step *= next(k for k in (1, 2, 5, 10) if (high - low) / (k * step) <= 6)
    return [low + k * step for k in range(int((high - low) / step) + 1)]


def write_page(records: Sequence[Record], lines: Sequence[str], file: Path) -> tuple[Path, Path]:
    """Write the plot and the page beside the file of a soak, and return their paths."""
    png, page = file.with_suffix(".png"), file.with_suffix(".html")
    drawn = io.BytesIO()
    draw(records).save(drawn, "PNG", optimize=True)
    png.write_bytes(drawn.getvalue())
    page.write_text(
        '<!doctype html><html lang="en"><meta charset="utf-8"><title>Soak</title>'
        "<style>body{font:15px/1.5 system-ui,sans-serif;max-width:1140px;margin:24px auto;"
        "padding:0 16px}img{max-width:100%}pre{overflow-x:auto}</style><h1>Soak</h1>"
        '<img alt="Memory, descriptors and latencies over the time of the soak" '
        f'src="data:image/png;base64,{base64.b64encode(drawn.getvalue()).decode()}">'
        f"<pre>{html.escape(chr(10).join(lines))}</pre></html>\n", encoding="utf-8")
    return png, page
