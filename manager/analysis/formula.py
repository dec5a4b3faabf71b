"""A fault tree as a Boolean formula, with all the connectives that other tools know.

`rampart.manager.model.fault_tree` is what a system spec can say, coherent and with one top. This is
what can be analysed: negation, exclusive or, cardinality, house events. Everything is a gate that
holds when the number of its inputs that hold lies between two bounds, or when it does not.
"""

from __future__ import annotations

from collections import Counter
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


def prepare(formula: Formula) -> tuple[dict[str, Connective], list[str]]:
    """Return the gates, with lone inputs gathered, and the modules, inner ones first.

    A module is a gate whose events occur nowhere else. It is analysed by itself and counts as one
    event above (Dutuit and Rauzy 1996). Inputs of a gate that no other gate uses are gathered into
    a gate of their own first, which is a module then.
    """
    gates = {name: formula.gates[name] for name in formula.sequence}
    if formula.top not in gates:
        return gates, []
    if not formula.is_monotone:
        return gates, [formula.top]  # below a negation a module's cut sets are not its own
    modules = _modules(gates, formula.top)
    users = Counter(entry for gate in gates.values() for entry in gate.inputs)
    for name in list(gates):
        gate = gates[name]
        uniform = gate.low in {1, len(gate.inputs)}
        lone = [e for e in gate.inputs if users[e] == 1 and e not in formula.house
                and (e not in gates or e in modules)]
        if uniform and 2 <= len(lone) < len(gate.inputs):
            gathered = f"{name}{GENERATED}lone"
            rest = [e for e in gate.inputs if e not in lone]
            for own, inputs in ((gathered, lone), (name, [gathered, *rest])):
                count = len(inputs)
                gates[own] = Connective(tuple(inputs), 1 if gate.low == 1 else count, count)
    return gates, _modules(gates, formula.top)


def _modules(gates: dict[str, Connective], top: str) -> list[str]:
    """Return the gates of which no descendant is used elsewhere, inner ones first.

    Dates of a depth-first search (Dutuit and Rauzy 1996): all descendants are met for the first
    time after the gate, and for the last time before the search leaves it.
    """
    first: dict[str, int] = {}
    last: dict[str, int] = {}
    left: dict[str, int] = {}  # gates, inner ones first
    date = 0
    stack: list[tuple[str, bool]] = [(top, False)]
    while stack:
        name, leaving = stack.pop()
        date += 1
        last[name] = date
        if leaving:
            left[name] = date
        elif name not in first:
            first[name] = date
            if name in gates:
                stack.append((name, True))
                stack.extend((entry, False) for entry in reversed(gates[name].inputs))
    earliest, latest = dict(first), dict(last)  # of what is below, too
    modules = []
    for name, left_at in left.items():
        below = gates[name].inputs
        met_first, met_last = min(earliest[e] for e in below), max(latest[e] for e in below)
        if first[name] < met_first and met_last < left_at and (len(below) > 1 or name == top):
            modules.append(name)
        earliest[name] = min(first[name], met_first)
        latest[name] = max(last[name], met_last)
    return modules
