"""How the mechanisms of a system are arranged: the FTMTree over them, an order of their recoveries.

A strategy sees nothing else of the system. Everything that it asks again and again is looked up in
tables of bitmasks that are made once, at load.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache, reduce
from operator import or_

from rampart.manager.model.mechanisms import Mechanisms
from rampart.manager.model.order import PartialOrder, Tree


class Arrangement:
    """Mechanisms, their FTMTree, and the order of their recoveries.

    Args:
        mechanisms: Registry of mechanisms and recovery contracts.
        tree: The FTMTree.
        order: The RM order; what is above is preferred when in doubt.

    Attributes:
        repairs: Recoveries that bring something back, as a bitmask of `order`.
        compound: Whether a mechanism runs more than one recovery.
        depth: How many mechanisms stand above each mechanism in the FTMTree.
        asks: Recoveries of each mechanism, as a bitmask of `order`.
    """

    def __init__(self, mechanisms: Mechanisms, tree: Tree, order: PartialOrder) -> None:
        self.mechanisms = mechanisms
        self.tree = tree
        self.order = order
        self.repairs = order.mask(
            name for name, contract in mechanisms.contracts.items() if contract.kind.repairs)
        self.compound = any(len(way) > 1 for way in mechanisms.recover.values())
        self.depth = {name: tree.up_set[bit].bit_count() - 1 for name, bit in tree.number.items()}
        self._width = len(tree.names)
        self._ftms = (1 << self._width) - 1
        self.asks = {name: order.mask(way) for name, way in mechanisms.recover.items()}
        self._bits = {name: tree.bit[name] | mask << self._width
                      for name, mask in self.asks.items()}
        self._conflicts = {name: order.mask(
            other for other in order.names if other != name and (
                mechanisms.overlap(name, other) or mechanisms.harms(name, other)
                or mechanisms.harms(other, name))) for name in order.names}

    def masks(self, active: Iterable[str]) -> tuple[int, int]:
        """Return the active mechanisms as a mask of `tree`, their recoveries as one of `order`."""
        bits = reduce(or_, map(self._bits.__getitem__, active), 0)
        return bits & self._ftms, bits >> self._width

    def demanded(self, active: Iterable[str]) -> tuple[str, ...]:
        """Return the recoveries that mechanisms ask for, each once, in the mechanisms' sequence."""
        return tuple(dict.fromkeys(
            recovery for name in active for recovery in self.mechanisms.recover[name]))

    def can_join(self, recovery: str, others: int) -> bool:
        """Tell whether a recovery can run beside others: no common claim, no need disabled."""
        return not self._conflicts[recovery] & others

    def compatible(self, recoveries: Iterable[str]) -> tuple[str, ...]:
        """Return those of some recoveries that can join those before them."""
        taken: list[str] = []
        mask = 0
        for name in recoveries:
            if self.can_join(name, mask):
                taken.append(name)
                mask |= self.order.bit[name]
        return tuple(taken)


arrange = lru_cache(maxsize=16)(Arrangement)
"""The arrangement of these three; the tables are made only the first time."""
