"""`rampart tree`: draw a system's fault tree, FTMTree and order of the recoveries.

In text, a box with several parents is drawn under the first; under the others, its name refers to
it (↑). A barrier stands on the branch of its event: `├─‖ event`.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from typing import Any

from rampart.cli import systems
from rampart.cli.output import UsageError, print_json, say_text
from rampart.cli.verbs import JSON, add_verb, option
from rampart.manager.drawing.diagram import WHATS, Box, Diagram, draw

ABOVE = "↑"


def to_text(diagrams: Sequence[Diagram]) -> str:
    """Return diagrams as text, separated by empty lines."""
    return "\n\n".join("\n".join(_lines(diagram)) for diagram in diagrams) + "\n"


def _lines(diagram: Diagram) -> list[str]:
    lines = [diagram.title]
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
    """Return the words of a box: name with its gate, title, barrier."""
    name = (diagram.what == "ftm-tree" and box.barrier_words) or box.name
    gate = f" [{box.gate_words}]" if box.gate else ""
    barrier = box.barrier_words if diagram.what == "fault-tree" else ""
    return list(filter(None, (name + gate, box.subtitle, barrier)))


def add(verbs: Any) -> None:
    """Add the verb to the parser."""
    add_verb(verbs, "tree", "draw fault tree, FTMTree and order of recoveries", show_tree,
             systems.choice(),
             option("--what", choices=(*WHATS, "all"), default="all",
                    help="which diagrams (default: all)"),
             JSON)


def show_tree(options: argparse.Namespace) -> int:
    """Print the diagrams.

    Draw the fault tree with the mechanisms as barriers (‖), the FTMTree that
    follows from it, and the order of the recoveries with the safer ones above.

    Examples:
      rampart tree
      rampart tree my_system.toml
      rampart tree --what fault-tree > fault_tree.txt
      rampart tree --what order --json
    """
    spec = systems.load(options.system)
    whats = WHATS if options.what == "all" else (options.what,)
    diagrams = [draw(spec, what) for what in whats]
    if options.json:
        print_json(diagrams)
        return 0
    text = to_text(diagrams)
    try:
        text.encode(sys.stdout.encoding or "utf-8")
    except UnicodeEncodeError:
        raise UsageError(f"stdout: encoding {sys.stdout.encoding} lacks characters of the tree; "
                         "set PYTHONUTF8=1") from None
    say_text(text.rstrip("\n"))
    return 0
