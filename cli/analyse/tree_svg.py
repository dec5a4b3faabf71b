"""Diagrams as SVG: a self-contained file, readable on white and on black.

Fault trees have the symbols of IEC 61025: rectangles for events, a circle below a basic event, the
distinctive gate shapes with their qualifier (≥1, &, ≥k). A mechanism is a barrier: two bars across
the line above its event. Each box has a `<title>`.
"""

from __future__ import annotations

import textwrap
import unicodedata
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec

from rampart.cli.output import rendered
from rampart.files.plain_text import one_line
from rampart.manager.drawing.diagram import Box, Diagram
from rampart.manager.drawing.placing import place

MARGIN = 24.0
FONT = 12.0
LINE = 15.0
WRAP = 20
"""A title breaks after about so many letters."""
TITLE_LINES = 3
LONGEST = 26
"""Letters of a gate beside a barrier; the rest is in its `<title>`."""
BARRIER = 42.0
"""Height of the stem that a barrier stands on."""
SYMBOL = 44.0
"""Height of a gate or circle with the stem above it."""
COMMON_WIDTH = 180.0
"""Rectangles are equally wide up to here: like things look alike, and lines get straight."""
TAGS = 124.0
"""Room for "asked for" and "decided" on both sides of a name."""


def to_svg(diagrams: Sequence[Diagram]) -> str:
    """Return diagrams as one SVG document, one below the other."""
    pictures = []
    y, width = MARGIN, 0.0
    for number, diagram in enumerate(diagrams):
        notes = _wrap(diagram.note, 90, 6) if number == 0 else []
        picture = _picture(diagram)
        placing, top = picture["placing"], 40 + LINE * len(notes)
        pictures.append({**picture, "diagram": diagram, "notes": notes, "y": y, "top": top})
        y += top + placing.height + 2 * MARGIN
        width = max(width, placing.width, text_width(diagram.title) * 17 / FONT,
                    *map(text_width, notes), 0)
    return rendered(
        Path(__file__).with_name("tree.svg.jinja"), escaped=True, pictures=pictures,
        width=width + 2 * MARGIN, height=y - MARGIN, MARGIN=MARGIN, LINE=LINE, SYMBOL=SYMBOL,
        tooltip=_tooltip, in_words=_in_words) + "\n"


def text_width(text: str) -> float:
    """Return the approximate width of a text at 12 px, rather too wide than too narrow."""
    return sum(FONT * (1.05 if unicodedata.east_asian_width(c) in "WF" else
                       0.36 if c in "ijlIft.,:;'|![]() " else
                       0.95 if c in "mwMW@%—" else
                       0.74 if not c.islower() and not c.isdigit() else 0.62) for c in text)


class _Look(msgspec.Struct, frozen=True):
    """The lines of a box, and its sizes."""

    lines: tuple[str, ...]
    barrier: tuple[str, str]
    """Texts left and right of the bars."""
    room: float
    """Width with the barrier."""
    width: float
    """Width of its rectangle."""


def _looks(diagram: Diagram) -> dict[str, _Look]:
    looks = {}
    fault_tree = diagram.what == "fault-tree"
    for box in diagram.boxes:
        readable = box.title or box.name.replace("_", " ").capitalize()
        lines = _wrap(readable, WRAP, TITLE_LINES) if fault_tree else [
            box.name, *_wrap(box.subtitle, WRAP + 8, TITLE_LINES)]
        if diagram.what == "ftm-tree":
            lines.insert(1, _cut(f"{box.detect} → {box.recover}"))
        barrier = ("", "")
        if fault_tree and box.mechanism:
            barrier = (box.mechanism, _cut(f"{box.detect} → {box.recover}"))
        wide = max(*map(text_width, lines), 64.0) + 22
        if not fault_tree and diagram.note:
            wide = max(wide, text_width(box.name) + TAGS)
        beside = 2 * max(map(text_width, barrier)) + 44 if barrier[0] else 0.0
        looks[box.name] = _Look(tuple(lines), barrier, round(beside), round(wide))
    common = min(max((look.width for look in looks.values()), default=0.0), COMMON_WIDTH)
    return {name: msgspec.structs.replace(
                look, width=max(common, look.width), room=max(common, look.width, look.room))
            for name, look in looks.items()}


def _picture(diagram: Diagram) -> dict[str, Any]:
    """Return the values of the template for a diagram."""
    fault_tree = diagram.what == "fault-tree"
    looks = _looks(diagram)
    tall = LINE * max((len(look.lines) for look in looks.values()), default=1) + 14
    stem = 0.0 if not fault_tree else BARRIER if any(
        box.mechanism for box in diagram.boxes) else 12.0
    height = stem + tall + (SYMBOL if fault_tree else 0)
    placing = place({name: (look.room, height) for name, look in looks.items()}, diagram.edges,
                    square=diagram.what != "order")
    leaving: dict[str, str] = {}  # one path per box: lines drawn twice would look thicker
    for (upper, _), line in zip(diagram.edges, placing.lines, strict=True):
        leaving[upper] = leaving.get(upper, "") + "M" + "L".join(f"{x:g} {y:g}" for x, y in line)
    return {"looks": looks, "tall": tall, "stem": stem, "placing": placing,
            "paths": list(leaving.values()), "lowers": {lower for _, lower in diagram.edges}}


def _tooltip(box: Box, diagram: Diagram) -> str:
    parts = [box.name, box.title, box.gate_words and f"gate: {box.gate_words}",
             box.barrier_words, box.active and diagram.active_words, box.decided and "decided"]
    return "; ".join(str(part) for part in parts if part)


def _in_words(diagram: Diagram) -> str:
    """Describe a diagram for screen readers."""
    below: dict[str, list[str]] = {}
    for upper, lower in diagram.edges:
        below.setdefault(upper, []).append(lower)
    sentences = [f"{diagram.title}.", diagram.note]
    for box in diagram.boxes:
        words = _tooltip(box, diagram)
        if box.name in below:
            words += f"; above {', '.join(below[box.name])}"
        sentences.append(f"{words}.")
    return " ".join(filter(None, sentences))


def _cut(text: str) -> str:
    return text if len(text) <= LONGEST else f"{text[:LONGEST - 1].rstrip()}…"


def _wrap(text: str, width: int, most: int) -> list[str]:
    """Break a text, and words that are too long, into at most `most` lines."""
    lines = textwrap.wrap(one_line(text), width, break_on_hyphens=False)
    if len(lines) > most:
        lines = [*lines[:most - 1], f"{lines[most - 1][:width - 1]}…"]
    return lines
