"""Families of sets as zero-suppressed decision diagrams, as far as minimal cut sets need them.

A node stands for a family of sets of variables: those with the node's variable, continued by
`high`, and those without, continued by `low` (Minato 1993). 0 is the empty family, 1 the family of
the empty set alone. Variables are numbered from the top.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager

from rampart.manager.analysis.formula import search

EMPTY, UNIT = 0, 1


class TooManyNodesError(ValueError):
    """A diagram that grows beyond its limit."""


class Diagram:
    """A binary decision diagram as plain numbers: 0 is false, 1 is true, inputs come first."""

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
        """Return the family of minimal sets of variables for which a node's function holds.

        Sets beyond the size that the store keeps are dropped where they would be made.
        """
        room = self._room(top, families)
        known = {EMPTY: EMPTY, UNIT: UNIT}
        for node in range(2, top + 1):  # inputs come before what uses them
            if room and room[node] < 0:
                known[node] = EMPTY
                continue
            level, low, high = self.level[node], known[self.low[node]], known[self.high[node]]
            if room:
                low = families.up_to(low, room[node])
                high = families.up_to(high, room[node] - families.least[level])
            rest = families.outside(high, self, self.low[node]) if monotone \
                else families.without(high, low)
            known[node] = families.node(level, rest, low)
        return known[top]

    def _room(self, top: int, families: Families) -> list[int]:
        """Return how many events a set may still have below each node; nothing without a limit."""
        if families.most is None:
            return []
        room = [-1] * (top + 1)
        room[top] = families.most
        for node in range(top, 1, -1):
            for below, taken in ((self.high[node], families.least[self.level[node]]),
                                 (self.low[node], 0)):
                room[below] = max(room[below], room[node] - taken)
        return room


class Families:
    """A store of families; equal families have equal numbers.

    Args:
        limit: Nodes that may be made.
        most: Events in a set that is kept; None for any number.
        least: For each variable, how many events it stands for at least; needed with `most`.
    """

    def __init__(self, limit: int, most: int | None = None, least: Sequence[int] = ()) -> None:
        self.most, self.least = most, least
        self._up_to: dict[tuple[int, int], int] = {}
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

    def up_to(self, u: int, most: int) -> int:
        """Return the sets of `u` with so many events at most."""
        if most < 0 or u == EMPTY:
            return EMPTY
        if u == UNIT:
            return UNIT
        key = (u, most)
        if (found := self._up_to.get(key)) is not None:
            return found
        x = self.variable[u]
        result = self.node(x, self.up_to(self.high[u], most - self.least[x]),
                           self.up_to(self.low[u], most))
        self._up_to[key] = result
        return result

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

        For the minimal solutions of a function the same as `without`, with half the steps.
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

    def upwards(self, family: int) -> tuple[int, ...]:
        """Return the nodes of a family, those below before those above."""
        return search(family, lambda node: (
            (self.high[node], self.low[node]) if node > UNIT else ()))[0]

    def sizes(self, family: int, weights: Sequence[Mapping[int, int]]) -> Counter[int]:
        """Return how many sets of each size a family has.

        Args:
            family: The family.
            weights: For each variable, how many sets of each size it stands for: one of size 1
                if it stands for itself.
        """
        found = {EMPTY: Counter[int](), UNIT: Counter({0: 1})}
        for node in self.upwards(family):
            found[node] = counts = found[self.low[node]].copy()
            for size, count in weights[self.variable[node]].items():
                for more, times in found[self.high[node]].items():
                    counts[size + more] += count * times
        return found[family]


@contextmanager
def deep_recursion(levels: int) -> Iterator[None]:
    """Allow recursion as deep as a diagram has levels; these frames lie on the heap."""
    before = sys.getrecursionlimit()
    sys.setrecursionlimit(max(before, 1000 + 6 * levels))
    try:
        yield
    finally:
        sys.setrecursionlimit(before)
