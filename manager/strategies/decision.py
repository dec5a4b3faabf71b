"""A decision and its certificate.

A decision names the recoveries to run. Its certificate gives the reasons, so that a reader, or a
proof checker, need not trust the program: which rule of the strategy applied, the chains of
dominance that make it apply, and every alternative that was turned down, with the reason.

Deciding and giving reasons are two steps, because a robot should brake first and explain after.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from typing import Protocol

import msgspec

from rampart.manager.model.order import PartialOrder
from rampart.manager.strategies.arrangement import Arrangement


class Decision(msgspec.Struct, frozen=True):
    """What to do about a set of active mechanisms.

    Attributes:
        active: The active mechanisms, in declared sequence.
        rule: Which rule of the strategy applied; for safety-first block 1 to 4 of the paper's
            figure 7. 0: nothing is active, so there is nothing to do.
        recoveries: To run; at most one under safety-first, where mechanisms are not compound.
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

Late = frozenset[str]


class Strategy(Protocol):
    """A policy without a state, so its answers can be remembered.

    It can be replaced without touching any detection or recovery module.
    """

    name: str
    patient: bool
    """Whether it asks how long recoveries have taken (`late`)."""
    exclusive: bool
    """Whether one recovery runs at a time, as the paper has it, even where two could."""
    rules: dict[int, str]
    """What each rule means, as the end of a sentence that begins with "because"."""

    def __hash__(self) -> int:
        """Strategies are told apart by identity."""

    def choose(self, active: tuple[str, ...], arrangement: Arrangement, late: Late) -> Decision:
        """Decide, without a certificate.

        Args:
            active: Active mechanisms, in declared sequence, at least one.
            arrangement: Mechanisms, tree, order.
            late: Those of them whose recovery has not ended the error within its patience.
        """

    def explain(self, decision: Decision, arrangement: Arrangement) -> Decision:
        """Return a decision of `choose` with `path` and `rejected`."""


def chains(order: PartialOrder, upper: str, lowers: Iterable[str]) -> tuple[str, ...]:
    """Return the chain from `upper` down to each of `lowers`, as text; `upper` itself excepted."""
    return tuple(" > ".join(order.chain(upper, lower)) for lower in lowers if lower != upper)


def dominance(order: PartialOrder, taken: Iterable[str], candidates: Sequence[str]
              ) -> tuple[str, ...]:
    """Return the chains from what was taken down to the candidates below it."""
    return tuple(" > ".join(order.chain(one, lower)) for one in taken for lower in candidates
                 if order.is_above(one, lower))


def turned_down(order: PartialOrder, taken: Collection[str], candidates: Iterable[str]
                ) -> tuple[tuple[str, str], ...]:
    """Return the candidates that were not taken, each with the reason."""
    return tuple((name, next((f"{one} is safer" for one in taken if order.is_above(one, name)),
                             "conflicts with another recovery"))
                 for name in candidates if name not in taken)


def undominated(order: PartialOrder, names: Iterable[str]) -> tuple[tuple[str, str], ...]:
    """Return, for each element of a set without a greatest, one that it does not dominate."""
    members = tuple(dict.fromkeys(names))
    return tuple((name, "does not dominate " + next(
        other for other in members if other != name and not order.is_above(name, other)))
        for name in members)
