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
from rampart.cli.output import UsageError, print_json, say_text, unknown
from rampart.cli.verbs import JSON, add_verb, option, word
from rampart.files.plain_text import one_line
from rampart.manager.drawing.diagram import WHATS, Box, Diagram, Situation, draw
from rampart.manager.model.order import CycleError
from rampart.manager.spec.schema import SystemSpec
from rampart.manager.strategies.registry import decide

ACTIVE = "●"
DECIDED = "◀ decided"
ABOVE = "↑"


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


def add(verbs: Any) -> None:
    """Add the verb to the parser."""
    add_verb(verbs, "tree", "draw fault tree, FTMTree and order of recoveries", show_tree,
             systems.choice(),
             option("--what", choices=(*WHATS, "all"), default="all",
                    help="which diagrams (default: all)"),
             JSON,
             option("--order", metavar="NAME", action="append",
                    help="order of recoveries; repeatable: each decides the pairs that the "
                         "previous ones leave open (default: the system's)"),
             option("--active", metavar="FTM", nargs="+", default=[],
                    help="active mechanisms, which are highlighted with the decision"),
             word("--strategy", "NAME", "strategy that decides (default: the system's)"))


def show_tree(options: argparse.Namespace) -> int:
    """Print the diagrams.

    Draw the fault tree with the mechanisms as barriers (‖), the FTMTree that
    follows from it, and the order of the recoveries with the safer ones above.

    Examples:
      rampart tree
      rampart tree my_system.toml
      rampart tree --what ftm-tree --active FTM3 FTM4
      rampart tree --what fault-tree > fault_tree.txt
      rampart tree --what order --json
    """
    spec = systems.load(options.system)
    diagrams = _draw(spec, WHATS if options.what == "all" else (options.what,), options)
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


