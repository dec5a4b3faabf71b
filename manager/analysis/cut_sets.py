"""Minimal cut sets, counted from decision diagrams without listing them.

A minimal cut set is a set of basic events that makes the top occur while no proper subset does
(IEC 61025). If the formula has negations, a set means that exactly its events occur; the minimal
sets are then Rauzy's minimal p-cuts.

The steps, for trees with hundreds of events and millions of cut sets:

1. *Modules* (`rampart.manager.analysis.formula`): each is analysed alone.
2. *A binary decision diagram* of each module, by the library OxiDD. Several depth-first searches
   give variable orders; the first order that keeps the diagram within bounds is taken.
3. *Minimal solutions* of the diagram, as a zero-suppressed one (Rauzy 1993). They give the number
   of sets of each size, by multiplication where a variable stands for a module.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cache, reduce
from itertools import chain, islice
from operator import and_, or_

import msgspec
from oxidd.bdd import BDDFunction, BDDManager
from oxidd.util import DDMemoryError

from rampart.manager.analysis.formula import Connective, Formula, prepare, search
from rampart.manager.analysis.zbdd import (
    EMPTY,
    UNIT,
    Diagram,
    Families,
    TooManyNodesError,
    deep_recursion,
)

BOUNDS = (30_000, 300_000, 1_000_000, 5_000_000, 20_000_000)
"""Nodes of a decision diagram: each bound is tried with every variable order before the next."""

_LEVELS = 20_000
"""Variables of a diagram: the library recurses by level, and aborts when its stack is full."""

_STACK = str(64 << 20)
"""Bytes for each thread of the library; its default takes 1 GB of address space."""

_LISTING_LEVELS = 800
"""Nested modules, and events in one, up to which sets are listed; counting has no such limit."""

Progress = Callable[[str], None]
_Way = Callable[[tuple[str, ...]], Sequence[str]]


class TooLargeError(ValueError):
    """A fault tree whose diagram exceeds the bounds with every variable order."""


class _Module(msgspec.Struct, frozen=True):
    """Minimal solutions of one module.

    Attributes:
        names: Names of its variables, from the top.
        families: Store of the family.
        family: The minimal solutions.
        sizes: For each node of the family, the number of cut sets of each size below it, those of
            inner modules multiplied out.
    """

    names: tuple[str, ...]
    families: Families
    family: int
    sizes: Mapping[int, Mapping[int, int]]


class CutSets:
    """The minimal cut sets of a formula.

    Args:
        formula: The fault tree.
        progress: Called with a line on each step.
        max_order: Sets with more events are neither listed nor counted; None for all.

    Attributes:
        sizes: How many minimal cut sets there are of each size, from 0 up.

    Raises:
        TooLargeError: No variable order keeps a diagram within the last bound.
    """

    def __init__(self, formula: Formula, progress: Progress = lambda _: None,
                 max_order: int | None = None) -> None:
        self.formula = formula
        self._gates, modules = prepare(formula)
        self._modules: dict[str, _Module] = {}
        self._constants = dict(formula.house)
        manager_of = cache(_new_manager)  # one for each bound: they keep their stacks for a while
        for number, name in enumerate(modules, 1):
            progress(f"module {number} of {len(modules)}: {name}")
            module = self._modules[name] = self._solve(name, progress, manager_of)
            if module.family in {EMPTY, UNIT}:  # by house events below it
                self._constants[name] = module.family == UNIT
        weight = self._weight(formula.top)
        largest = max((size for size in weight if max_order is None or size <= max_order),
                      default=-1)
        self.sizes = tuple(weight.get(size, 0) for size in range(largest + 1))

    @property
    def count(self) -> int:
        """How many minimal cut sets there are."""
        return sum(self.sizes)

    def sets(self, limit: int | None = None) -> Iterator[tuple[str, ...]]:
        """Yield minimal cut sets, smaller ones first, at most `limit` of them.

        Raises:
            TooLargeError: The tree is nested too deeply to list its sets; they can be counted.
        """
        depth: dict[str, int] = {}
        levels = 0
        for name, module in self._modules.items():  # inner ones come first
            depth[name] = 1 + max((depth.get(entry, 0) for entry in module.names), default=0)
            levels = max(levels, depth[name] + len(module.names))
        if levels > _LISTING_LEVELS:
            raise TooLargeError(f"nested {levels} levels deep: expected at most {_LISTING_LEVELS} "
                                "to list the sets; --count counts them")
        found = chain.from_iterable(
            self._of_size(self.formula.top, size) for size in range(len(self.sizes)))
        for events in islice(found, limit):
            yield tuple(sorted(events))

    def _weight(self, name: str) -> Mapping[int, int]:
        module = self._modules.get(name)
        if module is not None:
            return module.sizes[module.family]
        if name in self.formula.house:
            return {0: 1} if self.formula.house[name] else {}
        return {1: 1}

    def _of_size(self, name: str, size: int) -> Iterator[frozenset[str]]:
        module = self._modules.get(name)
        if module is not None:
            yield from self._paths(module, module.family, size)
        elif size in self._weight(name):
            yield frozenset((name,)) if size else frozenset()

    def _paths(self, module: _Module, node: int, size: int) -> Iterator[frozenset[str]]:
        if size not in module.sizes[node]:  # so no branch is a dead end
            return
        if node == UNIT:
            yield frozenset()
            return
        families = module.families
        name = module.names[families.variable[node]]
        for part in sorted(self._weight(name)):
            for rest in self._paths(module, families.high[node], size - part):
                for own in self._of_size(name, part):
                    yield own | rest
        yield from self._paths(module, families.low[node], size)

    def _solve(self, top: str, progress: Progress, manager_of: Callable[[int], BDDManager]
               ) -> _Module:
        inside = _Inside(self._gates, self._modules, self._constants, top)
        if len(inside.leaves) > _LEVELS:
            raise TooLargeError(f"gate {top!r}: {len(inside.leaves)} inputs and modules; expected "
                                f"at most {_LEVELS}")
        for bound in BOUNDS:
            progress(f"{top}: up to {bound} nodes")
            # To build a diagram is cheap, to find its minimal solutions is not: try all orders.
            built = [(diagram, order) for order in inside.orders()
                     if (diagram := inside.diagram(order, manager_of(bound))) is not None]
            for diagram, order in sorted(built, key=lambda found: len(found[0].level)):
                families = Families(bound)
                try:
                    with deep_recursion(len(order)):
                        family = diagram.minimal_solutions(
                            len(diagram.level) - 1, families, monotone=self.formula.is_monotone)
                except TooManyNodesError:
                    continue
                sizes = families.sizes(family, [self._weight(name) for name in order])
                return _Module(order, families, family, sizes)
        raise TooLargeError(f"gate {top!r} with {len(inside.leaves)} inputs and modules: more than "
                            f"{BOUNDS[-1]} nodes with every variable order tried")


def _new_manager(bound: int) -> BDDManager:
    """Return a manager of decision diagrams with at most `bound` nodes."""
    os.environ.setdefault("OXIDD_STACK_SIZE", _STACK)  # read when a manager is made
    return BDDManager(bound, max(1024, bound // 4), 1)


class _Inside:
    """The part of a formula between a module's gate and its events and modules."""

    def __init__(self, gates: dict[str, Connective], modules: dict[str, _Module],
                 constants: dict[str, bool], top: str) -> None:
        self._gates = gates
        self._house = constants
        self._top = top
        self._modules = modules
        self._sequence, self.leaves = self._search(lambda inputs: inputs)
        self._users = Counter(entry for name in self._sequence for entry in gates[name].inputs)

    def _search(self, way: _Way) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Search with the inputs of each gate ordered by `way`; return gates and leaves."""
        gates, leaves = search(self._top, lambda name: () if name != self._top and (
            name in self._modules or name not in self._gates) else way(self._gates[name].inputs))
        return gates, tuple(name for name in leaves if name not in self._house)

    def orders(self) -> Iterable[tuple[str, ...]]:
        """Return variable orders to try."""
        below: dict[str, int] = {}
        for name in self._sequence:
            below[name] = 1 + sum(below.get(entry, 1) for entry in self._gates[name].inputs)
        users = self._users
        ways: tuple[_Way, ...] = (
            lambda inputs: inputs,
            lambda inputs: sorted(inputs, key=lambda n: (-users[n], below.get(n, 1))),
            lambda inputs: sorted(inputs, key=lambda n: below.get(n, 1)),
            lambda inputs: sorted(inputs, key=lambda n: -below.get(n, 1)),
            lambda inputs: inputs[::-1])
        return dict.fromkeys(self._search(way)[1] for way in ways)

    def diagram(self, order: tuple[str, ...], manager: BDDManager) -> Diagram | None:
        """Return the module's decision diagram, or None if it grows beyond the manager's bound."""
        manager.gc()
        if (more := len(order) - manager.num_vars()) > 0:
            manager.add_vars(more)
        try:
            return _as_numbers(self._build(manager, order))
        except DDMemoryError:
            return None

    def _build(self, manager: BDDManager, order: tuple[str, ...]) -> BDDFunction:
        value = {name: manager.var(i) for i, name in enumerate(order)}
        for name, state in self._house.items():
            value[name] = manager.true() if state else manager.false()
        left, inner = self._users.copy(), set(self._sequence)
        for name in self._sequence:
            gate = self._gates[name]
            value[name] = _gate(manager, gate, [value[entry] for entry in gate.inputs])
            for entry in gate.inputs:  # so that the manager can collect it
                left[entry] -= 1
                if not left[entry] and entry in inner:
                    del value[entry]
        return value[self._top]


def _gate(manager: BDDManager, gate: Connective, inputs: list[BDDFunction]) -> BDDFunction:
    count = len(inputs)
    if gate.low == 1 and gate.high == count:
        result = reduce(or_, inputs, manager.false())
    elif gate.low == gate.high == count:
        result = reduce(and_, inputs, manager.true())
    else:
        result = _at_least(manager, inputs, gate.low)
        if gate.high < count:
            result = result & ~_at_least(manager, inputs, gate.high + 1)
    return ~result if gate.negated else result


def _at_least(manager: BDDManager, inputs: list[BDDFunction], required: int) -> BDDFunction:
    """Build k-of-n from the last input to the first: `rest[j]` is j of those seen so far."""
    rest = [manager.true(), *[manager.false()] * required]
    for entry in reversed(inputs):
        for j in range(required, 0, -1):
            rest[j] = entry.ite(rest[j - 1], rest[j])
    return rest[required]


def _as_numbers(function: BDDFunction) -> Diagram:
    """Copy a diagram into plain numbers; the top has the last one."""
    diagram = Diagram()
    inner, constants = search(function, lambda f: f.cofactors() or ())
    known = {f: UNIT if f.valid() else EMPTY for f in constants}
    for f in inner:
        high, low = f.cofactors() or (f, f)
        known[f] = diagram.add(f.node_level() or 0, known[high], known[low])
    if known[function] in {EMPTY, UNIT}:
        diagram.add(0, known[function], known[function])  # a constant, as the last number
    return diagram
