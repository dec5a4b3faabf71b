"""A fault tree as a Boolean formula, with all the connectives that other tools know.

`rampart.manager.model.fault_tree` is what a system spec can say, coherent and with one top. This is
what can be analysed: negation, exclusive or, cardinality, house events. Everything is a gate that
holds when the number of its inputs that hold lies between two bounds, or when it does not.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Hashable, Mapping, Sequence
from typing import TypeVar

import msgspec

from rampart.manager.model.fault_tree import FaultTree
from rampart.manager.model.order import find_cycle

Node = TypeVar("Node", bound=Hashable)

GENERATED = ".."
"""Stands in the names of gates and events that are made up; no name in a file can hold it."""


class FormulaError(ValueError):
    """A formula that cannot be analysed. The message is one line."""


class Connective(msgspec.Struct, frozen=True):
    """A gate: between `low` and `high` of its inputs hold; or, `negated`, they do not.

    An OR is 1 to n, an AND n to n, an exclusive or 1 to 1 of two, a NOT the negation of 1 to 1.
    """

    inputs: tuple[str, ...]
    low: int
    high: int
    negated: bool = False

    @property
    def is_monotone(self) -> bool:
        """Whether more inputs never make it cease to hold."""
        return not self.negated and self.high == len(self.inputs)


class Formula:
    """Gates over basic events and house events, seen from one top.

    Args:
        gates: By name.
        basic: Names of basic events; those that no gate below the top uses do not matter.
        house: Names of house events, each with its state.
        top: Name of the top gate or event; "" for the only gate that no other one uses.

    Raises:
        FormulaError: An unknown name, a cycle, no or several tops.
    """

    def __init__(self, gates: Mapping[str, Connective], basic: frozenset[str],
                 house: Mapping[str, bool], top: str = "") -> None:
        self.gates = dict(gates)
        self.house = dict(house)
        known = gates.keys() | basic | house.keys()
        for name, gate in gates.items():
            for entry in gate.inputs:
                if entry not in known:
                    raise FormulaError(f"gate {name!r} has the unknown input {entry!r}")
        cycle = find_cycle({name: gate.inputs for name, gate in gates.items()})
        if cycle:
            raise FormulaError(f"cycle {' > '.join(cycle)}; an event cannot be its own cause")
        self.top = top or self._only_top()
        if self.top not in known:
            raise FormulaError(f"unknown top {top!r}")
        self.sequence, leaves = search(
            self.top, lambda name: gates[name].inputs if name in gates else ())
        """Gates below the top and the top itself, inputs before what uses them."""
        self.basic = tuple(name for name in leaves if name in basic)
        """Basic events below the top, in the sequence in which depth-first search meets them."""
        self.is_monotone = all(gates[name].is_monotone for name in self.sequence)

    def _only_top(self) -> str:
        tops = self.gates.keys() - {entry for gate in self.gates.values() for entry in gate.inputs}
        if len(tops) != 1:
            raise FormulaError(
                f"{len(tops)} gates are no input of another: {first_few(tops)}; say which is the "
                "top" if tops else "no gates; a top is needed")
        return tops.pop()

    def holds(self, occurred: frozenset[str]) -> bool:
        """Tell whether the top occurs when exactly these basic events do."""
        value = {name: name in occurred for name in self.basic} | self.house
        for name in self.sequence:
            gate = self.gates[name]
            count = sum(value[entry] for entry in gate.inputs)
            value[name] = (gate.low <= count <= gate.high) != gate.negated
        return value[self.top]


def first_few(names: Collection[str]) -> str:
    """Return the first eight names of some, for a message."""
    return ", ".join(sorted(names)[:8]) + (", ..." if len(names) > 8 else "")


def search(top: Node, inputs: Callable[[Node], Sequence[Node]]
           ) -> tuple[tuple[Node, ...], tuple[Node, ...]]:
    """Search depth first, from the left.

    Returns:
        What has inputs, each after these; and what has none, as it is met.
    """
    gates: list[Node] = []
    leaves: list[Node] = []
    met: set[Node] = set()
    stack = [(top, False)]
    while stack:
        name, leaving = stack.pop()
        if leaving:
            gates.append(name)
        elif name not in met:
            met.add(name)
            below = inputs(name)
            if below:
                stack.append((name, True))
                stack += [(entry, False) for entry in reversed(below)]
            else:
                leaves.append(name)
    return tuple(gates), tuple(leaves)


def formula_of(tree: FaultTree) -> Formula:
    """Return the formula of a spec's fault tree."""
    gates = {name: Connective(event.inputs, event.required, len(event.inputs))
             for name, event in tree.events.items() if event.required}
    return Formula(gates, frozenset(tree.events) - gates.keys(), {}, tree.top)
