"""Diagrams in the language of Graphviz: one `digraph`, a cluster for each diagram.

A gate and a barrier are nodes of their own, below and above their event, so that they are seen
whatever the layout program does.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from rampart.manager.drawing.diagram import Box, Diagram

LIT = "#d9480f"
DECIDED = "#2b8a3e"
_GATE_SHAPES = {"or": "invtrapezium", "and": "invhouse", "at-least": "hexagon"}


def to_dot(diagrams: Sequence[Diagram]) -> str:
    """Return diagrams as one directed graph in DOT."""
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
        style |= {"style": "filled", "fillcolor": LIT, "fontcolor": "white"}
    if box.decided:
        style |= {"color": DECIDED, "penwidth": "3", "xlabel": "decided"}
    return style


def _attributes(label: str, style: dict[str, str]) -> str:
    return " [" + ", ".join(f"{key}={quote(value)}"
                            for key, value in {"label": label, **style}.items()) + "]"
