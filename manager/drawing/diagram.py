"""Diagrams of a system: its fault tree, its FTMTree, its order of the recoveries.

Each is a directed graph of boxes for any renderer.
"""

from __future__ import annotations

import msgspec

from rampart.files.plain_text import one_line
from rampart.manager.model.gates import detection_gate, recovery_gate
from rampart.manager.model.order import PartialOrder
from rampart.manager.spec.schema import MechanismSpec, SystemSpec

WHATS = ("fault-tree", "ftm-tree", "order")
"""Names of the diagrams."""


class Box(msgspec.Struct, frozen=True):
    """An event, a mechanism or a recovery.

    Attributes:
        gate: Gate of an event: "or", "and", "at-least"; "" for all other boxes.
        required: How many inputs the gate needs.
        inputs: How many inputs the gate has.
        mechanism: The mechanism of the box, or the barrier on the event.
    """

    name: str
    title: str = ""
    gate: str = ""
    required: int = 0
    inputs: int = 0
    mechanism: str = ""
    detect: str = ""
    recover: str = ""

    @property
    def subtitle(self) -> str:
        """The title, or "" if it only repeats the name."""
        words = "".join(c if c.isalnum() else " " for c in self.title.casefold()).split()
        return "" if words == self.name.casefold().split("_") else self.title

    @property
    def gate_words(self) -> str:
        """The gate in words: "or", "and", "2 of 3"; "" if there is none."""
        return f"{self.required} of {self.inputs}" if self.gate == "at-least" else self.gate

    @property
    def barrier_words(self) -> str:
        """The mechanism as in the paper, FTMx(DMy, RMz); "" if there is none."""
        return f"{self.mechanism}({self.detect}, {self.recover})" if self.mechanism else ""


class Diagram(msgspec.Struct, frozen=True):
    """A graph to draw: one of `WHATS`, with edges (upper box, lower box)."""

    what: str
    title: str
    boxes: tuple[Box, ...]
    edges: tuple[tuple[str, str], ...]


def draw(spec: SystemSpec, what: str) -> Diagram:
    """Return a diagram of a system, one of `WHATS`."""
    if what == "fault-tree":
        subject, parts = "Fault tree", _fault_tree(spec)
    elif what == "ftm-tree":
        subject, parts = "Tree of mechanisms", _ftm_tree(spec)
    else:
        subject = f"Order of recoveries ({', then '.join(map(one_line, spec.criteria))})"
        parts = _order(spec)
    return Diagram(what, f"{subject}: {one_line(spec.title)}", *parts)


def covers(order: PartialOrder) -> tuple[tuple[str, str], ...]:
    """Return the pairs of neighbours of an order: its transitive reduction (Hasse diagram)."""
    return tuple((upper, lower) for upper in order.names
                 for lower in order.maximal(order.members(order.below[order.number[upper]])))


_Parts = tuple[tuple[Box, ...], tuple[tuple[str, str], ...]]


def _fault_tree(spec: SystemSpec) -> _Parts:
    boxes = {}
    for event in spec.events:
        gate = event.gate if isinstance(event.gate, str) else "at-least" if event.of else ""
        boxes[event.name] = Box(
            event.name, one_line(event.title), gate, event.required, len(event.of))
    for mechanism in spec.mechanisms:
        boxes[mechanism.event] = _bar(boxes[mechanism.event], mechanism)
    return tuple(boxes.values()), tuple((e.name, lower) for e in spec.events for lower in e.of)


def _ftm_tree(spec: SystemSpec) -> _Parts:
    titles = {d.name: one_line(d.title) for d in spec.detections}
    titles |= {r.name: one_line(r.title) for r in spec.recoveries}
    boxes = []
    for mechanism in spec.mechanisms:
        detects, recovers = (str(gate.renamed(titles)) for gate in (
            detection_gate(mechanism.detect), recovery_gate(mechanism.recover)))
        box = Box(mechanism.name, f"{detects} → {recovers}")
        boxes.append(_bar(box, mechanism))
    parents = spec.build_ftm_tree().parents if boxes else {}
    return tuple(boxes), tuple((parent, m) for m, parent in parents.items() if parent is not None)


def _order(spec: SystemSpec) -> _Parts:
    return (tuple(Box(r.name, one_line(r.title)) for r in spec.recoveries),
            covers(spec.build_order()))


def _bar(box: Box, mechanism: MechanismSpec) -> Box:
    """Return a box with a mechanism."""
    return msgspec.structs.replace(
        box, mechanism=mechanism.name, detect=one_line(mechanism.detect),
        recover=one_line(mechanism.recover))
