"""A decision and its certificate.

A decision says which recovery is to run. Its certificate says why, so that a reader, or a proof
checker, need not trust the program: which block of the strategy applied, the chains of dominance
that make it apply, and every alternative that was turned down, with the reason.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import msgspec

from manager.mechanisms import Mechanisms
from manager.order import PartialOrder, Tree


class Decision(msgspec.Struct, frozen=True):
    """What to do about a set of active mechanisms.

    Attributes:
        active: The active mechanisms, in declared sequence.
        rule: Which rule of the strategy applied; for safety-first block 1 to 4 of the paper's
            figure 7. 0: nothing is active, so there is nothing to do.
        recoveries: To run; at most one under safety-first.
        mechanisms: For whose sake: those whose recovery was taken. Escalation starts from them.
        path: The dominance that justifies it: one chain for each dominated element, written
            `"FTM1 > FTM6 > FTM7"`, greatest first.
        rejected: Each alternative that was considered, and why it was not taken.
    """

    active: tuple[str, ...]
    rule: int = 0
    recoveries: tuple[str, ...] = ()
    mechanisms: tuple[str, ...] = ()
    path: tuple[str, ...] = ()
    rejected: tuple[tuple[str, str], ...] = ()


NOTHING_ACTIVE = Decision(active=())

Strategy = Callable[[Iterable[str], Mechanisms, Tree, PartialOrder], Decision]
"""A policy: a pure function (active mechanisms, mechanisms, FTMTree, RM order) -> Decision."""


def chains(order: PartialOrder, upper: str, lowers: Iterable[str]) -> tuple[str, ...]:
    """Return the chain from `upper` down to each of `lowers`, as text; `upper` itself excepted."""
    return tuple(" > ".join(order.chain(upper, lower)) for lower in lowers if lower != upper)


def undominated(order: PartialOrder, names: Iterable[str]) -> tuple[tuple[str, str], ...]:
    """Return, for each element of a set without a greatest, one that it does not dominate."""
    members = tuple(dict.fromkeys(names))
    return tuple(
        (name, "does not dominate " + next(
            other for other in members if other != name and not order.is_above(name, other)))
        for name in members)
