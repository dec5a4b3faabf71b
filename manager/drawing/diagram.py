"""Diagrams of a system: its fault tree, its FTMTree, its order of the recoveries.

Each is a directed graph of boxes for any renderer. The boxes show what is active and decided.
"""

from __future__ import annotations

from collections.abc import Sequence

import msgspec

from rampart.files.plain_text import one_line
from rampart.manager.model.gates import detection_gate, recovery_gate
from rampart.manager.model.order import PartialOrder
from rampart.manager.spec.schema import MechanismSpec, SystemSpec
from rampart.manager.strategies.registry import decision_in_words

WHATS = ("fault-tree", "ftm-tree", "order")
"""Names of the diagrams."""


class Box(msgspec.Struct, frozen=True):
    """An event, a mechanism or a recovery.

    Attributes:
        gate: Gate of an event: "or", "and", "at-least"; "" for all other boxes.
        required: How many inputs the gate needs.
        inputs: How many inputs the gate has.
        mechanism: The mechanism of the box, or the barrier on the event.
        active: The mechanism is active; of a recovery: an active mechanism has it.
        decided: The recovery runs, or the mechanism asks for one that runs; if no active mechanism
            does, each mechanism with that recovery.
    """

    name: str
    title: str = ""
    gate: str = ""
    required: int = 0
    inputs: int = 0
    mechanism: str = ""
    detect: str = ""
    recover: str = ""
    active: bool = False
    decided: bool = False

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
    """A graph to draw: one of `WHATS`, with edges (upper box, lower box).

    `note` is the situation in one line, "" if nothing is active.
    """

    what: str
    title: str
    note: str
    boxes: tuple[Box, ...]
    edges: tuple[tuple[str, str], ...]

    @property
    def active_words(self) -> str:
        """The word for an active box of this diagram."""
        return "asked for" if self.what == "order" else "active"


class Situation(msgspec.Struct, frozen=True):
    """Active mechanisms, and the decision on them."""

    active: frozenset[str] = frozenset()
    recoveries: tuple[str, ...] = ()
    rule: int = 0
    strategy: str = ""

    def note(self, spec: SystemSpec) -> str:
        """Return the situation in one line."""
        if not self.active:
            return ""
        active = [m.name for m in spec.mechanisms if m.name in self.active]
        return decision_in_words(active, self.rule, self.recoveries, self.strategy,
                                 spec.titles)


def draw(spec: SystemSpec, what: str, order: PartialOrder, criteria: Sequence[str],
         situation: Situation) -> Diagram:
    """Return a diagram of a system, one of `WHATS`.

    `criteria` are the names of the orders of which `order` consists.
    """
    if what == "fault-tree":
        subject, parts = "Fault tree", _fault_tree(spec, situation)
    elif what == "ftm-tree":
        subject, parts = "Tree of mechanisms", _ftm_tree(spec, situation)
    else:
        subject = f"Order of recoveries ({', then '.join(map(one_line, criteria))})"
        parts = _order(spec, order, situation)
    return Diagram(what, f"{subject}: {one_line(spec.title)}", situation.note(spec), *parts)


def covers(order: PartialOrder) -> tuple[tuple[str, str], ...]:
    """Return the pairs of neighbours of an order: its transitive reduction (Hasse diagram)."""
    return tuple((upper, lower) for upper in order.names
                 for lower in order.maximal(order.members(order.below[order.number[upper]])))


_Parts = tuple[tuple[Box, ...], tuple[tuple[str, str], ...]]


def _fault_tree(spec: SystemSpec, situation: Situation) -> _Parts:
    boxes = {}
    for event in spec.events:
        gate = event.gate if isinstance(event.gate, str) else "at-least" if event.of else ""
        boxes[event.name] = Box(
            event.name, one_line(event.title), gate, event.required, len(event.of))
    for mechanism in spec.mechanisms:
        boxes[mechanism.event] = _bar(boxes[mechanism.event], mechanism, spec, situation)
    return tuple(boxes.values()), tuple((e.name, lower) for e in spec.events for lower in e.of)


def _ftm_tree(spec: SystemSpec, situation: Situation) -> _Parts:
    titles = {d.name: one_line(d.title) for d in spec.detections}
    titles |= {r.name: one_line(r.title) for r in spec.recoveries}
    boxes = []
    for mechanism in spec.mechanisms:
        detects, recovers = (str(gate.renamed(titles)) for gate in (
            detection_gate(mechanism.detect), recovery_gate(mechanism.recover)))
        box = Box(mechanism.name, f"{detects} → {recovers}")
        boxes.append(_bar(box, mechanism, spec, situation))
    parents = spec.build_ftm_tree().parents if boxes else {}
    return tuple(boxes), tuple((parent, m) for m, parent in parents.items() if parent is not None)


def _order(spec: SystemSpec, order: PartialOrder, situation: Situation) -> _Parts:
    asked = {r for m in spec.mechanisms if m.name in situation.active for r in m.recoveries}
    boxes = tuple(Box(r.name, one_line(r.title), active=r.name in asked,
                      decided=r.name in situation.recoveries) for r in spec.recoveries)
    return boxes, covers(order)


def _bar(box: Box, mechanism: MechanismSpec, spec: SystemSpec, situation: Situation) -> Box:
    """Return a box with a mechanism.

    It counts as decided if its recovery runs and it is active. After block 4 no active mechanism
    has the recovery; then activity does not matter.
    """
    decided = [m.name for m in spec.mechanisms
               if not set(m.recoveries).isdisjoint(situation.recoveries)]
    active = mechanism.name in situation.active
    return msgspec.structs.replace(
        box, mechanism=mechanism.name, detect=one_line(mechanism.detect),
        recover=one_line(mechanism.recover), active=active, decided=mechanism.name in decided and (
            active or situation.active.isdisjoint(decided)))
