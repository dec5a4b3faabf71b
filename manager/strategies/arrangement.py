"""Mechanisms with their FTMTree and an order of their recoveries: all that a strategy sees."""

from __future__ import annotations

from collections.abc import Iterable

from rampart.manager.model.mechanisms import Mechanisms
from rampart.manager.model.order import PartialOrder, Tree


class Arrangement:
    """Mechanisms, their FTMTree, and the order of their recoveries.

    Args:
        mechanisms: Registry of mechanisms and recovery contracts.
        tree: The FTMTree.
        order: The RM order; in doubt the upper recovery is preferred.

    Attributes:
        compound: Whether a mechanism runs more than one recovery.
    """

    def __init__(self, mechanisms: Mechanisms, tree: Tree, order: PartialOrder) -> None:
        self.mechanisms = mechanisms
        self.tree = tree
        self.order = order
        self.compound = any(len(way) > 1 for way in mechanisms.recover.values())
        self._conflicts = {name: frozenset(
            other for other in order.names if other != name and (
                mechanisms.overlap(name, other) or mechanisms.harms(name, other)
                or mechanisms.harms(other, name))) for name in order.names}

    def demanded(self, active: Iterable[str]) -> tuple[str, ...]:
        """Return the recoveries that mechanisms ask for, each once, in their sequence."""
        return tuple(dict.fromkeys(
            recovery for name in active for recovery in self.mechanisms.recover[name]))

    def asking(self, names: Iterable[str], recoveries: Iterable[str]) -> tuple[str, ...]:
        """Return the mechanisms among `names` that ask for one of the recoveries."""
        wanted = frozenset(recoveries)
        return tuple(name for name in names
                     if not wanted.isdisjoint(self.mechanisms.recover[name]))

    def can_join(self, recovery: str, others: Iterable[str]) -> bool:
        """Return whether a recovery can run beside others: no common claim, no need disabled."""
        return self._conflicts[recovery].isdisjoint(others)

    def compatible(self, recoveries: Iterable[str], beside: Iterable[str] = ()) -> tuple[str, ...]:
        """Return `beside` and each further recovery that can join those before it."""
        taken = list(beside)
        for name in recoveries:
            if name not in taken and self.can_join(name, taken):
                taken.append(name)
        return tuple(taken)
