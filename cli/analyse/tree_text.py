"""Diagrams as text, drawn like `tree` does, and as DOT, for Graphviz.

A box with several above it is drawn once, under the first; elsewhere its name refers to it (↑).
A barrier stands on the branch that it bars: `├─‖ event`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from rampart.manager.drawing.diagram import Box, Diagram

ACTIVE = "●"
DECIDED = "◀ decided"
ABOVE = "↑"


def to_text(diagrams: Sequence[Diagram]) -> str:
    """Return diagrams as text, an empty line between two."""
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
    # (name, what stands before its children, its own branch); a stack, for trees may be deep.
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


_LIT = "#d9480f"
_GREEN = "#2b8a3e"
_GATE_SHAPES = {"or": "invtrapezium", "and": "invhouse", "at-least": "hexagon"}


def to_dot(diagrams: Sequence[Diagram]) -> str:
    """Return diagrams as one directed graph in DOT, a cluster for each.

    A gate and a barrier are nodes of their own, below and above their event, so that they are seen
    whatever the layout program does.
    """
    lines = ["digraph rampart {", '  graph [fontname="sans-serif", rankdir=TB];',
             '  node [fontname="sans-serif", shape=box];', "  edge [arrowhead=none];"]
    for diagram in diagrams:
        label = "\n".join(filter(None, (diagram.title, diagram.note)))
        lines += [f"  subgraph {quote(f'cluster {diagram.what}')} {{", f"    label={quote(label)};",
                  *(f"    {line};" for line in _statements(diagram)), "  }"]
    return "\n".join([*lines, "}"]) + "\n"


def quote(text: str) -> str:
    r"""Return text as a quoted string of DOT.

    Quotation marks and backslashes are escaped (`\N` would be a node's name), line ends become
    `\n`, and `&` becomes an entity, because Graphviz reads entities in labels.
    """
    text = text.replace("\\", "\\\\").replace('"', '\\"').replace("&", "&amp;")
    return '"' + text.replace("\n", "\\n") + '"'


def _statements(diagram: Diagram) -> Iterator[str]:
    barred = {box.name for box in diagram.boxes if diagram.what == "fault-tree" and box.mechanism}
    gated = {box.name for box in diagram.boxes if box.gate}

    def node(name: str, part: str = "") -> str:
        return quote(f"{diagram.what}/{name}{part}")

    for box in diagram.boxes:
        yield node(box.name) + _attributes(_label(box, diagram.what), _style(box, diagram.what))
        if box.gate:
            yield node(box.name, "/gate") + _attributes(
                box.gate_words, {"shape": _GATE_SHAPES[box.gate]})
            yield f"{node(box.name)} -> {node(box.name, '/gate')}"
        if box.name in barred:
            yield node(box.name, "/barrier") + _attributes(
                f"‖ {box.barrier_words}", {"peripheries": "2", **_lights(box)})
            yield f"{node(box.name, '/barrier')} -> {node(box.name)}"
    for upper, lower in diagram.edges:
        yield (f"{node(upper, '/gate' if upper in gated else '')} -> "
               f"{node(lower, '/barrier' if lower in barred else '')}")


def _label(box: Box, what: str) -> str:
    head = box.barrier_words if what == "ftm-tree" else box.name
    return "\n".join(filter(None, (head, box.subtitle)))


def _style(box: Box, what: str) -> dict[str, str]:
    if what == "fault-tree":
        return {} if box.gate else {"shape": "ellipse"}
    return _lights(box)


def _lights(box: Box) -> dict[str, str]:
    style: dict[str, str] = {}
    if box.active:
        style |= {"style": "filled", "fillcolor": _LIT, "fontcolor": "white"}
    if box.decided:
        style |= {"color": _GREEN, "penwidth": "3", "xlabel": "decided"}
    return style


def _attributes(label: str, style: dict[str, str]) -> str:
    return " [" + ", ".join(f"{key}={quote(value)}"
                            for key, value in {"label": label, **style}.items()) + "]"
