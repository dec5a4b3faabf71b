"""Layout of the fault tree with its barriers, and of the order of recoveries, for the page. Pure.

The fault tree grows from left to right, because its boxes are wider than high, so it can be read on
a telephone. The layout changes only when the system is adapted. The browser highlights it by the
manager's status.
"""

from __future__ import annotations

import textwrap
from typing import Any

import msgspec

from rampart.manager.drawing.diagram import Diagram, draw
from rampart.manager.drawing.placing import place
from rampart.manager.spec.clearing import clearing_in_words, never_cleared
from rampart.manager.spec.schema import SystemSpec

MAX_BOXES = 300
"""Largest tree that is drawn; the layout of a larger one would keep the node busy."""

LETTERS = 22
"""Longest line of a box."""
LINES = 3
LINE = 14.0
BOX_WIDTH = 156.0
BARRIER = 78.0
"""Length of the line with the barrier before a box."""
SYMBOL = 34.0
"""Length of the gate after a box."""
STUB = 16.0
"""Length of the line before a box in a tree without barriers."""


class Shape(msgspec.Struct, frozen=True):
    """A box of a drawing, with its upper left corner; y grows downwards.

    For an event, `gate` is its qualifier ("&", "≥2", "≥1"; "" for a basic event), `mechanism` its
    barrier, `detect` and `recover` the gates of that, and `way` the events above it, up to the
    first one with a barrier.
    """

    name: str
    title: str
    lines: tuple[str, ...]
    x: float
    y: float
    width: float
    height: float
    gate: str = ""
    mechanism: str = ""
    detect: str = ""
    recover: str = ""
    detections: tuple[str, ...] = ()
    recoveries: tuple[str, ...] = ()
    way: tuple[str, ...] = ()


class Line(msgspec.Struct, frozen=True):
    """A line from an upper box to a lower one, through points."""

    upper: str
    lower: str
    points: tuple[tuple[float, float], ...]


class Drawing(msgspec.Struct, frozen=True):
    """Boxes and lines from (0, 0) to (width, height); `words` is the description of the drawing."""

    title: str
    width: float
    height: float
    boxes: tuple[Shape, ...]
    lines: tuple[Line, ...]
    words: str = ""


def draw_system(spec: SystemSpec) -> dict[str, Any]:
    """Return the drawings of a system's fault tree and of its order of recoveries.

    A drawing is None if the system has none, or if it is too large (see `note`).
    """
    tree, ranks = draw(spec, "fault-tree"), draw(spec, "order")
    note = (f"The fault tree has {len(tree.boxes)} events, too many to draw (at most {MAX_BOXES})."
            if len(tree.boxes) > MAX_BOXES else "")
    return {"title": spec.title or spec.name, "titles": spec.titles,
            "clearing": clearing_in_words(spec), "never_cleared": never_cleared(spec),
            "strategy": spec.strategy, "criteria": spec.criteria, "note": note,
            "tree": _fault_tree(spec, tree) if 0 < len(tree.boxes) <= MAX_BOXES else None,
            "order": _order(ranks) if 0 < len(ranks.boxes) <= MAX_BOXES else None}


def _fault_tree(spec: SystemSpec, diagram: Diagram) -> Drawing:
    stem = BARRIER if spec.mechanisms else STUB
    texts = {box.name: _wrap(box.title or box.name.replace("_", " ").capitalize())
             for box in diagram.boxes}
    tall = {name: LINE * max(2, len(lines)) + 12 for name, lines in texts.items()}
    # The layout goes downwards; turned over, its x is our y.
    placing = place({box.name: (tall[box.name], stem + BOX_WIDTH + (SYMBOL if box.gate else 0))
                     for box in diagram.boxes}, diagram.edges, square=True)
    mechanisms = {m.name: m for m in spec.mechanisms}
    above: dict[str, list[str]] = {box.name: [] for box in diagram.boxes}
    for upper, lower in diagram.edges:
        above[lower].append(upper)
    barriers = {box.name for box in diagram.boxes if box.mechanism}
    boxes = []
    for box in diagram.boxes:
        at = placing.places[box.name]
        mechanism = mechanisms.get(box.mechanism)
        qualifier = "&" if box.gate == "and" else f"≥{box.required}" if box.gate else ""
        boxes.append(Shape(
            box.name, box.title or box.name, texts[box.name], at.top + stem, at.left, BOX_WIDTH,
            tall[box.name], qualifier, box.mechanism, box.detect, box.recover,
            mechanism.detections if mechanism else (), mechanism.recoveries if mechanism else (),
            _way(box.name, above, barriers)))
    lines = tuple(Line(upper, lower, tuple((y, x) for x, y in points))
                  for (upper, lower), points in zip(diagram.edges, placing.lines, strict=True))
    return Drawing(diagram.title, placing.height, placing.width, tuple(boxes), lines,
                   _in_words(diagram))


def _order(diagram: Diagram) -> Drawing:
    texts = {box.name: (box.name, *_wrap(box.subtitle)) for box in diagram.boxes}
    tall = {name: LINE * len(lines) + 14 for name, lines in texts.items()}
    placing = place({box.name: (BOX_WIDTH, tall[box.name]) for box in diagram.boxes},
                    diagram.edges, square=False)
    at = placing.places
    boxes = tuple(Shape(box.name, box.title or box.name, texts[box.name], at[box.name].left,
                        at[box.name].top, BOX_WIDTH, tall[box.name]) for box in diagram.boxes)
    lines = tuple(Line(upper, lower, points) for (upper, lower), points
                  in zip(diagram.edges, placing.lines, strict=True))
    return Drawing(diagram.title, placing.width, placing.height, boxes, lines, _in_words(diagram))


def _way(event: str, above: dict[str, list[str]], barriers: set[str]) -> tuple[str, ...]:
    """Return the events above an event, up to and including those with a barrier."""
    way: dict[str, None] = {}
    to_do = list(above[event])
    while to_do:
        upper = to_do.pop(0)
        if upper not in way:
            way[upper] = None
            if upper not in barriers:
                to_do += above[upper]
    return tuple(way)


def _wrap(text: str) -> tuple[str, ...]:
    return tuple(textwrap.wrap(text, LETTERS, max_lines=LINES, placeholder="…"))


def _in_words(diagram: Diagram) -> str:
    below: dict[str, list[str]] = {}
    names = {box.name: box.title or box.name for box in diagram.boxes}
    for upper, lower in diagram.edges:
        below.setdefault(upper, []).append(names[lower])
    parts = []
    for box in diagram.boxes:
        words = [names[box.name]]
        if box.mechanism:
            words.append(f"barrier {box.barrier_words}")
        if box.name in below:
            how = f"{box.gate_words} of" if box.gate else "above"
            words.append(f"{how} {', '.join(below[box.name])}")
        parts.append(f"{'; '.join(words)}.")
    return " ".join(parts)
