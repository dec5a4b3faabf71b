"""A decision, its certificate, and the interface of a strategy.

A decision names the recoveries to run. Its certificate lets a reader or a proof checker verify it:
the rule of the strategy, the chains of dominance by which it applies, and each rejected alternative
with the reason. The certificate is a second step, so that the robot brakes before it explains.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from typing import Protocol

import msgspec

from rampart.manager.model.order import PartialOrder
from rampart.manager.strategies.arrangement import Arrangement


class Decision(msgspec.Struct, frozen=True):
    """The recoveries to run for a set of active mechanisms.

    Attributes:
        active: The active mechanisms, in declared sequence.
        rule: Number of the strategy's rule; for safety-first block 1 to 4 of the paper's figure 7.
            0: no mechanism is active.
        recoveries: The recoveries; at most one under safety-first unless mechanisms are compound.
        mechanisms: The mechanisms whose recoveries these are; escalation starts from them.
        path: One chain of dominance for each dominated element, greatest first:
            `"FTM1 > FTM6 > FTM7"`.
        rejected: Each rejected alternative, and why.
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
    """A policy without state, so that its decisions can be cached."""

    name: str
    patient: bool
    """Whether it uses `late`, the mechanisms whose recovery takes too long."""
    exclusive: bool
    """Whether one recovery runs at a time, as in the paper, even where two could."""
    rules: dict[int, str]
    """Meaning of each rule, as the end of a sentence that begins with "because"."""

    def __hash__(self) -> int:
        """Hash by identity."""

    def choose(self, active: tuple[str, ...], arrangement: Arrangement, late: Late) -> Decision:
        """Decide, without a certificate.

        Args:
            active: Active mechanisms, in declared sequence, at least one.
            arrangement: Mechanisms, tree, order.
            late: The active mechanisms whose recovery did not end the error within its patience.
        """

    def explain(self, decision: Decision, arrangement: Arrangement) -> Decision:
        """Return a decision of `choose` with `path` and `rejected`."""


def chains(order: PartialOrder, upper: str, lowers: Iterable[str]) -> tuple[str, ...]:
    """Return the chains from `upper` down to each of `lowers`, as text, without `upper` itself."""
    return tuple(" > ".join(order.chain(upper, lower)) for lower in lowers if lower != upper)


def dominance(order: PartialOrder, taken: Iterable[str], candidates: Sequence[str]
              ) -> tuple[str, ...]:
    """Return the chains from the taken elements down to the candidates below them."""
    return tuple(" > ".join(order.chain(upper, lower)) for upper in taken for lower in candidates
                 if order.is_above(upper, lower))


def turned_down(order: PartialOrder, taken: Collection[str], candidates: Iterable[str]
                ) -> tuple[tuple[str, str], ...]:
    """Return the candidates that were not taken, each with the reason."""
    return tuple((name, next((f"{upper} is safer" for upper in taken
                              if order.is_above(upper, name)), "conflicts with another recovery"))
                 for name in candidates if name not in taken)


def undominated(order: PartialOrder, names: Iterable[str]) -> tuple[tuple[str, str], ...]:
    """Return for each element of a set without a greatest another that it does not dominate."""
    members = tuple(dict.fromkeys(names))
    return tuple((name, "does not dominate " + next(
        other for other in members if other != name and not order.is_above(name, other)))
        for name in members)
