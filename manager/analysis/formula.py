"""A fault tree as a Boolean formula, with all connectives of other tools.

A system spec has coherent trees with one top (`rampart.manager.model.fault_tree`). The analysis
also takes negation, exclusive or, cardinality and house events. Every gate holds if the number of
its inputs that hold lies between two bounds; a negated gate holds if it does not.
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
"""Part of the names of generated gates and events; no name in a file can contain it."""


class FormulaError(ValueError):
    """A formula that cannot be analysed. The message is one line."""


class Connective(msgspec.Struct, frozen=True):
    """A gate: between `low` and `high` of its inputs hold; if `negated`, they do not.

    An OR is 1 to n, an AND n to n, an exclusive or 1 to 1 of two, a NOT the negation of 1 to 1.
    """

    inputs: tuple[str, ...]
    low: int
    high: int
    negated: bool = False

    @property
    def is_monotone(self) -> bool:
        """Whether a further input that holds never makes the gate cease to hold."""
        return not self.negated and self.high == len(self.inputs)


class Formula:
    """Gates over basic events and house events, seen from one top.

    Args:
        gates: By name.
        basic: Names of basic events; those that no gate below the top uses are ignored.
        house: Names of house events, each with its state.
        top: Name of the top gate or event; "" for the only gate that no other gate uses.

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
                f"{len(tops)} gates are not an input of another gate: {first_few(tops)}; name the "
                "top gate" if tops else "no gates; expected a top gate")
        return tops.pop()


def first_few(names: Collection[str]) -> str:
    """Return the first eight names, for a message."""
    return ", ".join(sorted(names)[:8]) + (", ..." if len(names) > 8 else "")


def search(top: Node, inputs: Callable[[Node], Sequence[Node]]
           ) -> tuple[tuple[Node, ...], tuple[Node, ...]]:
    """Search depth first, from the left.

    Returns:
        Nodes with inputs, each after its inputs; and nodes without, in the sequence of the search.
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

    A module is a gate whose events occur nowhere else. It is analysed alone, and counts as one
    event above (Dutuit and Rauzy 1996). Inputs that only one gate uses are gathered into a new
    gate first, which is then a module.
    """
    gates = {name: formula.gates[name] for name in formula.sequence}
    if formula.top not in gates:
        return gates, []
    if not formula.is_monotone:
        return gates, [formula.top]  # below a negation a module cannot be analysed alone
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
    """Return the gates whose descendants are used nowhere else, inner ones first.

    By the dates of a depth-first search (Dutuit and Rauzy 1996): it meets all descendants for the
    first time after the gate, and for the last time before it leaves the gate.
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
    earliest, latest = dict(first), dict(last)  # descendants included
    modules = []
    for name, left_at in left.items():
        below = gates[name].inputs
        met_first, met_last = min(earliest[e] for e in below), max(latest[e] for e in below)
        if first[name] < met_first and met_last < left_at and (len(below) > 1 or name == top):
            modules.append(name)
        earliest[name] = min(first[name], met_first)
        latest[name] = max(last[name], met_last)
    return modules
