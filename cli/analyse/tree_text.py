"""Diagrams as text, as `tree` draws folders.

A box with several parents is drawn under the first; under the others, its name refers to it (↑).
A barrier stands on the branch of its event: `├─‖ event`.
"""

from __future__ import annotations

from collections.abc import Sequence

from rampart.manager.drawing.diagram import Box, Diagram

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
        lines.append(f"{before}{mark}{_describe(box, diagram)}")
        if branch:
            before += "    " if branch[0] == "└" else "│   "
        for index, lower in enumerate(reversed(below[name])):
            to_do.append((lower, before, "├─" if index else "└─"))
    return lines


def _describe(box: Box, diagram: Diagram) -> str:
    parts = [box.name]
    if box.gate:
        parts.append(f"[{box.gate_words}]")
    if diagram.what == "ftm-tree":
        parts = [box.barrier_words]
    if box.subtitle:
        parts.append(f" {box.subtitle}")
    if diagram.what == "fault-tree" and box.mechanism:
        parts.append(f" {box.barrier_words}")
    if box.active:
        parts.append(f" {ACTIVE} {diagram.active_words}")
    if box.decided:
        parts.append(f" {DECIDED}")
    return " ".join(parts)
