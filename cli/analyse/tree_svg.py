"""Diagrams as SVG: one file, nothing outside it, readable on white and on black.

Fault trees are drawn with the symbols of IEC 61025: rectangles for events, a circle below a basic
event, the distinctive gate shapes, and in them the qualifier (≥1, &, ≥k). A mechanism is a barrier,
two bars across the line above its event. What can be pointed at has a `<title>`.
"""

from __future__ import annotations

import textwrap
import unicodedata
from collections.abc import Iterator, Sequence
from xml.sax.saxutils import escape, quoteattr

import msgspec

from rampart.manager.drawing.diagram import Box, Diagram, clean
from rampart.manager.drawing.placing import Place, place

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
GATE = 15.0
"""Half the width of a gate."""
COMMON_WIDTH = 180.0
"""Rectangles are equally wide up to here: like things look alike, and lines get straight."""
TAGS = 124.0
"""Room for "asked for" and "decided" on both sides of a name."""

_STYLE = """
  svg { background: var(--paper); color-scheme: light dark;
    --paper: #ffffff; --ink: #1f2933; --faint: #66727f; --line: #5c6773; --fill: #f4f6f8;
    --bar: #1864ab; --lit: #c92a2a; --lit-fill: #ffe3e3; --go: #2b8a3e; --go-fill: #d3f9d8; }
  @media (prefers-color-scheme: dark) { svg {
    --paper: #14181d; --ink: #e6eaee; --faint: #9aa5b1; --line: #8793a0; --fill: #222931;
    --bar: #74c0fc; --lit: #ff8787; --lit-fill: #4a1f22; --go: #69db7c; --go-fill: #1b3a24; } }
  text { font: 12px system-ui, "Segoe UI", Roboto, "DejaVu Sans", sans-serif; fill: var(--ink);
    text-anchor: middle; }
  .left { text-anchor: start; } .right { text-anchor: end; }
  .head { font-size: 17px; font-weight: 600; text-anchor: start; }
  .note { fill: var(--lit); text-anchor: start; }
  .name { font-weight: 600; } .small { font-size: 10px; }
  .faint { fill: var(--faint); font-size: 11px; }
  .line { fill: none; stroke: var(--line); stroke-width: 1.3; stroke-linejoin: round; }
  .box, .gate { fill: var(--fill); stroke: var(--line); stroke-width: 1.3; }
  .bar { stroke: var(--bar); stroke-width: 3.5; stroke-linecap: round; }
  .barrier { fill: var(--bar); font-weight: 600; }
  .active .box { fill: var(--lit-fill); stroke: var(--lit); stroke-width: 2.2; }
  .active .bar { stroke: var(--lit); } .active .barrier { fill: var(--lit); }
  .decided .go { fill: var(--go); font-weight: 600; }
  .decided .frame { fill: none; stroke: var(--go); stroke-width: 2.2; }
"""


def to_svg(diagrams: Sequence[Diagram]) -> str:
    """Return diagrams as one SVG picture, one below the other."""
    body: list[str] = []
    y, width = MARGIN, 0.0
    for number, diagram in enumerate(diagrams):
        notes = _wrap(diagram.note, 90, 6) if number == 0 else []
        picture = _Picture(diagram)
        head = [_text(diagram.title, 0, 16, "head"), *(
            _text(line, 0, 36 + LINE * i, "note") for i, line in enumerate(notes))]
        top = 40 + LINE * len(notes)
        body += [f'<g transform="translate({MARGIN:g} {y:g})" role="group" '
                 f'aria-label={quoteattr(diagram.title)}>', *head,
                 f'<g transform="translate(0 {top:g})">', *picture.body(), "</g>", "</g>"]
        y += top + picture.placing.height + 2 * MARGIN
        width = max(width, picture.placing.width, text_width(diagram.title) * 17 / FONT,
                    *map(text_width, notes), 0)
    y -= MARGIN
    width += 2 * MARGIN
    title = "; ".join(diagram.title for diagram in diagrams)
    return "\n".join([
        f'<svg xmlns="http://www.w3.org/2000/svg" role="img" aria-labelledby="title desc" '
        f'width="{width:g}" height="{y:g}" viewBox="0 0 {width:g} {y:g}">',
        f'<title id="title">{escape(title)}</title>',
        f'<desc id="desc">{escape(" ".join(map(_in_words, diagrams)))}</desc>',
        f"<style>{_STYLE}</style>", *body, "</svg>"]) + "\n"


def text_width(text: str) -> float:
    """Return about how wide a text is at 12 px, rather too wide than too narrow."""
    return sum(FONT * (1.05 if unicodedata.east_asian_width(c) in "WF" else
                       0.36 if c in "ijlIft.,:;'|![]() " else
                       0.95 if c in "mwMW@%—" else
                       0.74 if not c.islower() and not c.isdigit() else 0.62) for c in text)


class _Look(msgspec.Struct, frozen=True):
    """A box as it is drawn: its lines of text, and the sizes that are the same for a diagram."""

    lines: tuple[str, ...]
    barrier: tuple[str, str]
    """What stands left and right of the bars."""
    room: float
    """Width that it needs, barrier included."""
    width: float
    """Of its rectangle."""


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


class _Picture:
    """A diagram with the place of each box and each line."""

    def __init__(self, diagram: Diagram) -> None:
        self.diagram = diagram
        self.looks = _looks(diagram)
        self.fault_tree = diagram.what == "fault-tree"
        self.tall = LINE * max((len(look.lines) for look in self.looks.values()), default=1) + 14
        self.stem = 0.0 if not self.fault_tree else BARRIER if any(
            box.mechanism for box in diagram.boxes) else 12.0
        height = self.stem + self.tall + (SYMBOL if self.fault_tree else 0)
        self.placing = place({name: (look.room, height) for name, look in self.looks.items()},
                             diagram.edges, square=diagram.what != "order")

    def body(self) -> Iterator[str]:
        """Yield the elements, lines first."""
        leaving: dict[str, list[str]] = {}
        for (upper, _), line in zip(self.diagram.edges, self.placing.lines, strict=True):
            leaving.setdefault(upper, []).append("M" + "L".join(f"{x:g} {y:g}" for x, y in line))
        for lines in leaving.values():  # one path, for what is painted twice looks thicker
            yield f'<path class="line" d="{"".join(lines)}"/>'
        lowers = {lower for _, lower in self.diagram.edges}
        for box in self.diagram.boxes:
            at, look = self.placing.places[box.name], self.looks[box.name]
            classes = " ".join(["node", *["active"] * box.active, *["decided"] * box.decided])
            yield f'<g class="{classes}"><title>{escape(_tooltip(box, self.diagram))}</title>'
            if self.fault_tree:
                if box.name in lowers or box.mechanism:
                    yield _line(at.x, at.top, at.x, at.top + self.stem)
                if box.mechanism:
                    yield from _barrier(look, at.x, at.top + self.stem / 2)
                yield from _symbol(box, at.x, at.bottom - SYMBOL)
            yield from self._rectangle(box, look, at)
            yield "</g>"

    def _rectangle(self, box: Box, look: _Look, at: Place) -> Iterator[str]:
        top, left = at.top + self.stem, at.x - look.width / 2
        yield (f'<rect class="box" x="{left:g}" y="{top:g}" width="{look.width:g}" '
               f'height="{self.tall:g}" rx="3"/>')
        if not self.fault_tree and box.decided:
            yield (f'<rect class="frame" x="{left - 4:g}" y="{top - 4:g}" '
                   f'width="{look.width + 8:g}" height="{self.tall + 8:g}" rx="6"/>')
            yield _text("decided", left + look.width - 6, top + 12, "go right small")
        if not self.fault_tree and box.active:
            yield _text(self.diagram.active_words, left + 6, top + 12, "left small")
        y = top + self.tall / 2 - LINE * len(look.lines) / 2 + 11.5
        for number, line in enumerate(look.lines):
            kind = "" if self.fault_tree else "faint" if number else "name"
            yield _text(line, at.x, y + LINE * number, kind)


def _barrier(look: _Look, x: float, y: float) -> Iterator[str]:
    for bar_y in (y - 4, y + 4):
        yield f'<path class="bar" d="M{x - 13:g} {bar_y:g}h26"/>'
    yield _text(look.barrier[0], x - 19, y + 4, "barrier right")
    yield _text(look.barrier[1], x + 19, y + 4, "go left")


def _symbol(box: Box, x: float, y: float) -> Iterator[str]:
    """Draw the gate, or the circle, below an event whose rectangle ends at y."""
    yield _line(x, y, x, y + 12)
    y += SYMBOL
    if not box.gate:
        yield f'<circle class="gate" cx="{x:g}" cy="{y - 17:g}" r="14"/>'
        return
    left, right = x - GATE, x + GATE
    if box.gate == "and":
        qualifier = "&"
        outline = (f"M{left:g} {y - 2:g}V{y - 18:g}A{GATE:g} {GATE + 1:g} 0 0 1 "
                   f"{right:g} {y - 18:g}V{y - 2:g}Z")
        yield _line(x, y - 2, x, y)
    else:
        qualifier = f"≥{box.required}"
        yield _line(x, y - 8, x, y)
        outline = (f"M{left:g} {y - 1:g}Q{left:g} {y - 22:g} {x:g} {y - 34:g}"
                   f"Q{right:g} {y - 22:g} {right:g} {y - 1:g}Q{x:g} {y - 14:g} {left:g} "
                   f"{y - 1:g}Z")
    yield f'<path class="gate" d="{outline}"/>'
    yield _text(qualifier, x, y - 12, "small")


def _line(x1: float, y1: float, x2: float, y2: float) -> str:
    return f'<path class="line" d="M{x1:g} {y1:g}L{x2:g} {y2:g}"/>'


def _text(text: str, x: float, y: float, kind: str = "") -> str:
    kind = f' class="{kind}"' if kind else ""
    return f'<text{kind} x="{x:g}" y="{y:g}">{escape(text)}</text>'


def _tooltip(box: Box, diagram: Diagram) -> str:
    parts = [box.name, box.title, box.gate_words and f"gate: {box.gate_words}",
             box.barrier_words, box.active and diagram.active_words, box.decided and "decided"]
    return "; ".join(str(part) for part in parts if part)


def _in_words(diagram: Diagram) -> str:
    """Describe a diagram for those who do not see it."""
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
    """Break a text into at most so many lines; a word too long for one is broken as well."""
    lines = textwrap.wrap(clean(text), width, break_on_hyphens=False)
    if len(lines) > most:
        lines = [*lines[:most - 1], f"{lines[most - 1][:width - 1]}…"]
    return lines
