"""Families of sets as zero-suppressed decision diagrams, for minimal cut sets.

A node is a family of sets of variables (Minato 1993): `high` continues the sets with the node's
variable, `low` those without. 0 is the empty family, 1 the family that holds only the empty set.
Variables are numbered from the top.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager

from rampart.manager.analysis.formula import search

EMPTY, UNIT = 0, 1


class TooManyNodesError(ValueError):
    """A diagram exceeds its limit of nodes."""


class Diagram:
    """A binary decision diagram as plain numbers: 0 is false, 1 is true, children come first."""

    def __init__(self) -> None:
        self.level = [1 << 60, 1 << 60]
        self.high = [0, 1]
        self.low = [0, 1]

    def add(self, level: int, high: int, low: int) -> int:
        """Add a node and return its number."""
        self.level.append(level)
        self.high.append(high)
        self.low.append(low)
        return len(self.level) - 1

    def minimal_solutions(self, top: int, families: Families, *, monotone: bool) -> int:
        """Return the family of minimal sets of variables for which a node's function holds."""
        known = {EMPTY: EMPTY, UNIT: UNIT}
        for node in range(2, top + 1):
            low, high = known[self.low[node]], known[self.high[node]]
            rest = families.outside(high, self, self.low[node]) if monotone \
                else families.without(high, low)
            known[node] = families.node(self.level[node], rest, low)
        return known[top]


class Families:
    """A store of families, with at most `limit` nodes; equal families have equal numbers."""

    def __init__(self, limit: int) -> None:
        self.variable = [1 << 60, 1 << 60]
        self.high = [EMPTY, UNIT]
        self.low = [EMPTY, UNIT]
        self._limit = limit
        self._nodes: dict[tuple[int, int, int], int] = {}
        self._without: dict[tuple[int, int], int] = {}
        self._outside: dict[int, int] = {}

    def node(self, variable: int, high: int, low: int) -> int:
        """Return the family {s + variable: s in high} + low.

        Raises:
            TooManyNodesError: The limit is reached.
        """
        if high == EMPTY:
            return low
        key = (variable, high, low)
        found = self._nodes.get(key)
        if found is None:
            found = len(self.variable)
            if found > self._limit:
                raise TooManyNodesError(f"more than {self._limit} nodes")
            self._nodes[key] = found
            self.variable.append(variable)
            self.high.append(high)
            self.low.append(low)
        return found

    def without(self, u: int, v: int) -> int:
        """Return the sets of `u` that include no set of `v` (Rauzy 1993)."""
        if EMPTY in (u, v):
            return u
        if v in (UNIT, u):
            return EMPTY
        if u == UNIT:
            return u
        key = (u, v)
        if (found := self._without.get(key)) is not None:
            return found
        x, y = self.variable[u], self.variable[v]
        if x == y:
            high = self.without(self.without(self.high[u], self.high[v]), self.low[v])
            result = self.node(x, high, self.without(self.low[u], self.low[v]))
        elif x < y:
            result = self.node(x, self.without(self.high[u], v), self.without(self.low[u], v))
        else:
            result = self.without(u, self.low[v])
        self._without[key] = result
        return result

    def outside(self, u: int, diagram: Diagram, f: int) -> int:
        """Return the sets of `u` for which the monotone function `f` does not hold.

        For minimal solutions this equals `without`, with half the steps.
        """
        if EMPTY in (f, u):
            return u
        if f == UNIT:
            return EMPTY
        if u == UNIT:
            return u  # a monotone function that is not constant does not hold for the empty set
        key = u << 32 | f
        if (found := self._outside.get(key)) is not None:
            return found
        x, y = self.variable[u], diagram.level[f]
        if x == y:
            result = self.node(x, self.outside(self.high[u], diagram, diagram.high[f]),
                               self.outside(self.low[u], diagram, diagram.low[f]))
        elif x < y:
            result = self.node(x, self.outside(self.high[u], diagram, f),
                               self.outside(self.low[u], diagram, f))
        else:
            result = self.outside(u, diagram, diagram.low[f])
        self._outside[key] = result
        return result

    def sizes(self, family: int, weights: Sequence[Mapping[int, int]]
              ) -> dict[int, Mapping[int, int]]:
        """Return for each node of a family the number of sets of each size below it.

        `weights` has, for each variable, the number of sets of each size that it stands for: one
        of size 1 if it stands for itself.
        """
        found: dict[int, Mapping[int, int]] = {EMPTY: {}, UNIT: {0: 1}}
        nodes, _ = search(family, lambda node: (
            (self.high[node], self.low[node]) if node > UNIT else ()))
        for node in nodes:
            counts = Counter(found[self.low[node]])
            for size, count in weights[self.variable[node]].items():
                for more, times in found[self.high[node]].items():
                    counts[size + more] += count * times
            found[node] = counts
        return found


@contextmanager
def deep_recursion(levels: int) -> Iterator[None]:
    """Allow recursion as deep as a diagram has levels; the frames lie on the heap."""
    before = sys.getrecursionlimit()
    sys.setrecursionlimit(max(before, 1000 + 6 * levels))
    try:
        yield
    finally:
        sys.setrecursionlimit(before)
