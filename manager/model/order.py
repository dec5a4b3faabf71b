"""Partial orders and trees over names, as bitmasks.

The strategy asks two questions of the FTMTree and of the RMGraph: *which member of this set is
above all the others?* and *which element is the closest one above all of them?* (paper, section
IV-A, `dom` and `low_com_dom`). A few integer operations answer both.

Elements are numbered along a linear extension of the order, greater ones first. So whatever is
above an element has a lower bit than the element itself, and

* the greatest element of a set, if it exists, is the set's lowest bit; it is the greatest iff
  all other bits of the set lie in its down-set;
* in a tree the common ancestors of a set form a chain, so the closest is the highest bit in the
  intersection of the members' up-sets.

`dom` is the *greatest element of the partial order*. The paper defines it by control flow ("every
path from the root goes through"), but its own RMGraph examples hold only for the order: RM2 and
RM5 both lead to RM3, so no path argument makes RM5 dominate it, yet dom{RM5, RM3, RM4} = RM5. On
a tree the two definitions agree.
"""

from __future__ import annotations

import graphlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import reduce
from graphlib import TopologicalSorter
from itertools import product
from operator import or_


class CycleError(ValueError):
    """A relation has a cycle; `cycle` has the names along it, the first one again at the end."""

    def __init__(self, cycle: Sequence[str]) -> None:
        self.cycle = tuple(cycle)
        super().__init__(f"cycle {' > '.join(self.cycle)}")


class UnknownElementError(ValueError):
    """A name is not an element of the order."""


def find_cycle(above: Mapping[str, Iterable[str]]) -> tuple[str, ...] | None:
    """Return a cycle of a directed graph, the first name again at the end, or None."""
    try:
        TopologicalSorter(above).prepare()
    except graphlib.CycleError as error:
        return tuple(reversed(error.args[1]))
    return None


class PartialOrder:
    """A strict partial order, closed transitively when built.

    Args:
        names: All elements. Their sequence breaks ties in the numbering, so output is stable.
        above: Element → elements below it, neither transitively closed nor reduced.

    Raises:
        CycleError: The relation has a cycle.
    """

    def __init__(self, names: Sequence[str], above: Mapping[str, Iterable[str]]) -> None:
        relation = {name: tuple(above.get(name, ())) for name in names}
        cycle = find_cycle(relation)
        if cycle:
            raise CycleError(cycle)
        self.names = _linear_extension(relation)
        self.number = {name: bit for bit, name in enumerate(self.names)}
        self.bit = {name: 1 << bit for name, bit in self.number.items()}
        below = [0] * len(self.names)
        up_set = [1 << bit for bit in range(len(self.names))]
        for bit, name in enumerate(self.names):  # an element is complete before those below it
            for lower in relation[name]:
                up_set[self.number[lower]] |= up_set[bit]
        for bit, name in reversed(tuple(enumerate(self.names))):
            for lower in relation[name]:
                below[bit] |= self.bit[lower] | below[self.number[lower]]
        self.below, self.up_set = tuple(below), tuple(up_set)

    def mask(self, names: Iterable[str]) -> int:
        """Return the set of `names` as a bitmask; an unknown one raises UnknownElementError."""
        mask = 0
        try:
            for name in names:
                mask |= self.bit[name]
        except KeyError as error:
            raise UnknownElementError(
                f"unknown {error.args[0]!r}; known: {', '.join(sorted(self.names))}") from None
        return mask

    def members(self, mask: int) -> tuple[str, ...]:
        """Return the names in a bitmask, greater ones first."""
        return tuple(name for bit, name in enumerate(self.names) if mask >> bit & 1)

    def is_above(self, upper: str, lower: str) -> bool:
        """Return whether `upper` is strictly above `lower`."""
        return bool(self.below[self.number[upper]] & self.bit[lower])

    def greatest(self, names: Iterable[str]) -> str | None:
        """Return the member above all other members (`dom` of the paper), or None."""
        mask = self.mask(names)
        lowest = mask & -mask
        bit = lowest.bit_length() - 1
        if bit < 0 or mask & ~(self.below[bit] | lowest):
            return None
        return self.names[bit]

    def maximal(self, names: Iterable[str]) -> tuple[str, ...]:
        """Return the maximal members, greater ones first."""
        mask, found = self.mask(names), []
        while mask:  # the lowest bit is maximal, and elements below it are not
            bit = (mask & -mask).bit_length() - 1
            found.append(self.names[bit])
            mask &= ~(self.below[bit] | 1 << bit)
        return tuple(found)

    def chain(self, upper: str, lower: str) -> tuple[str, ...]:
        """Return a maximal chain from `upper` down to `lower`, both included.

        No element lies between two neighbours of the chain.

        Raises:
            ValueError: `upper` is neither `lower` nor above it.
        """
        if upper != lower and not self.is_above(upper, lower):
            raise ValueError(f"{upper} is not above {lower}")
        steps = [upper]
        target = self.up_set[self.number[lower]]
        while steps[-1] != lower:
            between = self.below[self.number[steps[-1]]] & target
            steps.append(self.names[(between & -between).bit_length() - 1])
        return tuple(steps)


def refine(criteria: Sequence[PartialOrder]) -> PartialOrder:
    """Return the order in which each criterion decides pairs that those before it leave open.

    Args:
        criteria: Orders over the same elements, the most important first; at least one.

    Raises:
        CycleError: The criteria contradict each other: the first puts a above b, the second puts
            b above c and c above a.
    """
    first = criteria[0]
    above = {name: list(first.members(first.below[first.number[name]])) for name in first.names}
    for order in criteria[1:]:
        settled = PartialOrder(first.names, above)
        for upper in order.names:
            above[upper] += [lower for lower in order.members(order.below[order.number[upper]])
                             if not settled.is_above(upper, lower)
                             and not settled.is_above(lower, upper)]
    return first if len(criteria) == 1 else PartialOrder(first.names, above)


class Tree(PartialOrder):
    """A tree in which a parent is above its children.

    Args:
        parents: Element → parent; exactly one element, the root, has None.
    """

    def __init__(self, parents: Mapping[str, str | None]) -> None:
        children: dict[str, list[str]] = {name: [] for name in parents}
        for name, parent in parents.items():
            if parent is not None:
                children[parent].append(name)
        super().__init__(tuple(parents), children)
        self.root = next(name for name, parent in parents.items() if parent is None)
        self.parents = dict(parents)

    def lowest_common_dominant(self, names: Iterable[str]) -> str:
        """Return the closest element above or equal to all `names` (`low_com_dom` of the paper).

        Raises:
            ValueError: `names` is empty.
        """
        mask = self.mask(names)
        if not mask:
            raise ValueError("the empty set has no lowest common dominant")
        bit = (mask & -mask).bit_length() - 1
        common = self.up_set[bit]
        # Climb from the first member until all others are below. Each step goes up, so there are
        # at most as many steps as the tree is deep.
        while rest := mask & ~(self.below[bit] | 1 << bit):
            common &= self.up_set[rest.bit_length() - 1]
            bit = common.bit_length() - 1
        return self.names[bit]


def contradictions(tree: Tree, order: PartialOrder, of: Mapping[str, Sequence[str]]
                   ) -> Iterator[tuple[str, str, str, str]]:
    """Yield where the order of recoveries contradicts the FTMTree; `of`: mechanism → recoveries.

    Yields:
        An upper mechanism, a lower one, and a recovery of the lower one that is above a recovery
        of the upper one.
    """
    own = {name: order.mask(owned) for name, owned in of.items()}
    under = {name: reduce(or_, (order.below[order.number[r]] for r in owned))
             for name, owned in of.items()}
    for upper in tree.names:
        for lower in tree.members(tree.below[tree.number[upper]]):
            if under[lower] & own[upper]:
                yield from ((upper, lower, high, low) for high, low in product(of[lower], of[upper])
                            if order.is_above(high, low))


def _linear_extension(relation: Mapping[str, Iterable[str]]) -> tuple[str, ...]:
    """Return the names of an acyclic relation, upper ones first; ties keep the sequence."""
    sorter = TopologicalSorter[str](dict.fromkeys(relation, ()))
    for upper, lowers in relation.items():
        for lower in lowers:
            sorter.add(lower, upper)
    return tuple(sorter.static_order())
