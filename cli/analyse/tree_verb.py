"""`rampart tree`: draw a system's fault tree, FTMTree and order of the recoveries.

In text, a box with several parents is drawn under the first; under the others, its name refers to
it (↑). A barrier stands on the branch of its event: `├─‖ event`. SVG has the same words in boxes.
"""

from __future__ import annotations

import argparse
import sys
import textwrap
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import msgspec
from rich.cells import cell_len

from rampart.cli import systems
from rampart.cli.output import UsageError, say, unknown
from rampart.cli.verbs import JSON_FORMAT, add_verb, option, word
from rampart.files.plain_text import one_line
from rampart.manager.drawing.diagram import WHATS, Box, Diagram, Situation, draw
from rampart.manager.drawing.placing import place
from rampart.manager.model.order import CycleError
from rampart.manager.spec.schema import SystemSpec
from rampart.manager.strategies.registry import decide

ACTIVE = "●"
DECIDED = "◀ decided"
ABOVE = "↑"

_WRAP = 28
"""Letters of a line in a picture."""

_MARGIN, _LINE, _LETTER = 24.0, 15.0, 7.3
"""Sizes in a picture: of its margin, of a line of text, and of a letter of 12 px."""


def to_text(diagrams: Sequence[Diagram]) -> str:
    """Return diagrams as text, separated by empty lines."""
    return "\n\n".join("\n".join(_lines(diagram, noted=number == 0))
                       for number, diagram in enumerate(diagrams)) + "\n"


def _lines(diagram: Diagram, *, noted: bool) -> list[str]:
    lines = [diagram.title]
    if diagram.note and noted:
        lines.append(diagram.note)
    boxes = {box.name: box for box in diagram.boxes}
    below: dict[str, list[str]] = {name: [] for name in boxes}
    lowers = {lower for _, lower in diagram.edges}
    for upper, lower in diagram.edges:
        below[upper].append(lower)
    if not boxes:
        lines.append("(empty)")
    drawn: set[str] = set()
    # Name, indentation, branch. A stack, because a tree can be deeper than Python's recursion.
    to_do = [(name, "", "") for name in reversed(boxes) if name not in lowers]
    while to_do:
        name, before, branch = to_do.pop()
        box = boxes[name]
        barred = diagram.what == "fault-tree" and bool(box.mechanism)
        mark = branch + ("‖ " if barred else "─ " if branch else "")
        if name in drawn:
            lines.append(f"{before}{mark}{name} {ABOVE}")
            continue
        drawn.add(name)
        lines.append(f"{before}{mark}{'  '.join(_words(box, diagram))}")
        if branch:
            before += "    " if branch[0] == "└" else "│   "
        for index, lower in enumerate(reversed(below[name])):
            to_do.append((lower, before, "├─" if index else "└─"))
    return lines


def _words(box: Box, diagram: Diagram) -> list[str]:
    """Return the words of a box: name with its gate, title, barrier, situation."""
    name = (diagram.what == "ftm-tree" and box.barrier_words) or box.name
    gate = f" [{box.gate_words}]" if box.gate else ""
    barrier = box.barrier_words if diagram.what == "fault-tree" else ""
    active = f"{ACTIVE} {diagram.active_words}" if box.active else ""
    return list(filter(None, (
        name + gate, box.subtitle, barrier, active, DECIDED if box.decided else "")))


def to_svg(diagrams: Sequence[Diagram]) -> str:
    """Return diagrams as one SVG document, one below the other."""
    root = ET.Element("svg", {"xmlns": "http://www.w3.org/2000/svg", "fill": "none",
                              "stroke": "gray", "font-family": "monospace", "font-size": "12"})
    wide, tall = 0.0, _MARGIN
    for diagram in diagrams:
        words = {box.name: [line for text in _words(box, diagram)
                            for line in textwrap.wrap(text, _WRAP)] for box in diagram.boxes}
        placing = place({name: (_LETTER * (2 + max(map(cell_len, lines))), _LINE * (len(lines) + 1))
                         for name, lines in words.items()}, diagram.edges, square=True)
        group = ET.SubElement(root, "g", transform=f"translate({_MARGIN:g} {tall:g})")
        head = [diagram.title, *filter(None, [diagram.note])]
        _write(group, head, 0, -_LINE / 2)
        tree = ET.SubElement(group, "g", transform=f"translate(0 {_LINE * (len(head) + 1):g})")
        for line in placing.lines:
            ET.SubElement(tree, "polyline", points=" ".join(f"{x:g},{y:g}" for x, y in line))
        for name, lines in words.items():
            at = placing.places[name]
            ET.SubElement(tree, "rect", x=f"{at.left:g}", y=f"{at.top:g}",
                          width=f"{at.width:g}", height=f"{at.height:g}")
            _write(tree, lines, at.left + _LETTER, at.top)
        wide = max(wide, placing.width, _LETTER * max(map(cell_len, head)))
        tall += _LINE * (len(head) + 1) + placing.height + 2 * _MARGIN
    root.attrib |= {"width": f"{wide + 2 * _MARGIN:g}", "height": f"{tall:g}"}
    ET.indent(root)
    return ET.tostring(root, "unicode") + "\n"


def _write(group: ET.Element, lines: Sequence[str], x: float, y: float) -> None:
    """Add lines of text below a point."""
    for number, line in enumerate(lines, 1):
        text = ET.SubElement(group, "text", x=f"{x:g}", y=f"{y + _LINE * (number + 0.2):g}",
                             fill="gray", stroke="none")
        text.text = line


def to_json(diagrams: Sequence[Diagram]) -> str:
    """Return diagrams as a list of JSON objects."""
    return msgspec.json.format(msgspec.json.encode(diagrams), indent=2).decode() + "\n"


FORMATS: dict[str, Callable[[Sequence[Diagram]], str]] = {
    "text": to_text, "svg": to_svg, "json": to_json}
_ENDINGS = {".svg": "svg", ".json": "json", ".txt": "text"}


def add(verbs: Any) -> None:
    """Add the verb to the parser."""
    add_verb(verbs, "tree", "draw fault tree, FTMTree and order of recoveries", show_tree,
             systems.choice(),
             option("--what", choices=(*WHATS, "all"), default="all",
                    help="which diagrams (default: all)"),
             option("--format", choices=tuple(FORMATS),
                    help="format (default: by the ending of --output, else text)"),
             JSON_FORMAT,
             word("--output", "FILE", "write to FILE instead of standard output"),
             option("--order", metavar="NAME", action="append",
                    help="order of recoveries; repeatable: each decides the pairs that the "
                         "previous ones leave open (default: the system's)"),
             option("--active", metavar="FTM", nargs="+", default=[],
                    help="active mechanisms, which are highlighted with the decision"),
             word("--strategy", "NAME", "strategy that decides (default: the system's)"))


def show_tree(options: argparse.Namespace) -> int:
    """Print or write the diagrams.

    Draw the fault tree with the mechanisms as barriers (‖), the FTMTree that
    follows from it, and the order of the recoveries with the safer ones above.

    Examples:
      rampart tree
      rampart tree my_system.toml
      rampart tree --what ftm-tree --active FTM3 FTM4
      rampart tree --what fault-tree --output fault_tree.svg
      rampart tree --what order --json
    """
    ending = Path(options.output).suffix.lower() if options.output else ""
    if ending and not options.format and ending not in _ENDINGS:
        raise UsageError(f"--output {options.output}: unknown ending; expected "
                         f"{', '.join(_ENDINGS)}, or --format")
    form = options.format or _ENDINGS.get(ending, "text")
    spec = systems.load(options.system)
    diagrams = _draw(spec, WHATS if options.what == "all" else (options.what,), options)
    text = FORMATS[form](diagrams)
    if options.output is None:
        _print(text)
        return 0
    Path(options.output).write_text(text, encoding="utf-8")
    for diagram in diagrams:
        say(f"{options.output}: {diagram.what}, {len(diagram.boxes)} boxes, "
            f"{len(diagram.edges)} lines")
    return 0


def _draw(spec: SystemSpec, whats: Sequence[str], options: argparse.Namespace
          ) -> tuple[Diagram, ...]:
    criteria = tuple(options.order or spec.criteria)
    for name in criteria:
        if name not in spec.orders:
            raise unknown("order", name, map(one_line, spec.orders))
    strategy = options.strategy or spec.strategy
    try:
        order = spec.build_order(*criteria)
    except CycleError as error:
        raise UsageError(f"--order {' '.join(criteria)}: together they form a {error}") from None
    situation = Situation()
    if options.active or options.strategy:
        decision = decide(options.active, spec.build_mechanisms(), spec.build_ftm_tree(),
                          order, strategy)
        situation = Situation(frozenset(decision.active), decision.recoveries, decision.rule,
                              strategy)
    return tuple(draw(spec, what, order, criteria, situation) for what in whats)


def _print(text: str) -> None:
    try:
        text.encode(sys.stdout.encoding or "utf-8")
    except UnicodeEncodeError:
        raise UsageError(f"stdout: encoding {sys.stdout.encoding} lacks characters of the tree; "
                         "use --output FILE") from None
    sys.stdout.write(text)
    sys.stdout.flush()
