"""What a strategy decides, checked for every set of active mechanisms.

Exhaustive: all 2^n - 1 sets, and for a strategy that asks which mechanisms are late, all ways in
which some of them can be. Counterexamples are found smallest first.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from itertools import chain, combinations
from typing import TypeVar

import msgspec

from rampart.manager.model.order import PartialOrder
from rampart.manager.strategies.arrangement import Arrangement
from rampart.manager.strategies.decision import Decision, Strategy
from rampart.manager.strategies.decision_words import listing
from rampart.manager.strategies.escalation import succession

MAX_MECHANISMS = 14
"""2^14 sets are checked in seconds; above that verification refuses."""

KEPT = 3
"""Counterexamples kept of each property; all are counted."""


class Property(msgspec.Struct, frozen=True):
    """One property of one strategy, as checked.

    Attributes:
        name: See `docs/verification.md`.
        strategy: Of which strategy; "" if it does not depend on one.
        holds: No counterexample exists.
        cases: How many cases were checked.
        count: In how many of them it fails.
        counterexamples: The first few, shortest first; each a trace, one line a step.
    """

    name: str
    strategy: str
    holds: bool
    cases: int
    count: int
    counterexamples: tuple[tuple[str, ...], ...]


Trace = tuple[str, ...]
T = TypeVar("T")


class Case(msgspec.Struct, frozen=True):
    """A question to a strategy, and its answer."""

    active: tuple[str, ...]
    late: frozenset[str]
    decision: Decision

    def describe(self) -> str:
        """Say what is active and what is run."""
        late = f", {listing(sorted(self.late))} late" if self.late else ""
        return (f"{listing(self.active)} active{late}: runs {listing(self.decision.recoveries)} "
                f"(rule {self.decision.rule})")


class ActiveSets:
    """All active sets of an arrangement under one strategy.

    Args:
        arrangement: Mechanisms, tree, the order that the strategy uses.
        safety: The order that says what is safer.
        strategy: To check.
    """

    def __init__(self, arrangement: Arrangement, safety: PartialOrder, strategy: Strategy) -> None:
        self.arrangement = arrangement
        self.safety = safety
        self.strategy = strategy
        names = arrangement.mechanisms.names
        self.cases = [
            Case(active, frozenset(late), strategy.choose(active, arrangement, frozenset(late)))
            for size in range(1, len(names) + 1)
            for active in combinations(names, size)
            for late in (subsets(active) if strategy.patient else ((),))]
        self._by_set = {(case.active, case.late): case for case in self.cases}
        tree, recover = arrangement.tree, arrangement.mechanisms.recover
        self.last_resort = frozenset(recover[tree.root])
        self._milder: dict[tuple[tuple[str, ...], tuple[str, ...]], tuple[str, str] | None] = {}

    def check(self) -> Iterator[Property]:
        """Check every property in turn."""
        for name, find in (
                ("one-decision", self._no_single_decision),
                ("no-conflicting-claims", self._conflicting_claims),
                ("safe-enough", self._too_unsafe),
                ("emergency-stop-at-once", self._stop_not_taken),
                ("escalation-ends", self._escalation_without_end),
                ("monotone", self._less_safe_with_more),
                ("no-harm", self._harm),
                ("repairs-run", self._starving_repair)):
            yield judge(name, self.strategy.name, self.cases, find)

    @property
    def stops_for_good(self) -> int:
        """In how many sets a recovery is run that stays until an operator resets it."""
        contracts = self.arrangement.mechanisms.contracts
        return sum(any(contracts[r].latched for r in case.decision.recoveries)
                   for case in self.cases if not case.late)

    @property
    def stuck_behind_last_resort(self) -> int:
        """In how many sets a latched last resort runs, and a repair that is needed never does.

        `repairs-run` exempts these: the robot stands, and somebody has to come anyhow. But the
        reset is refused as long as the last resort is decided on, which is as long as nobody
        repairs by hand.
        """
        return sum(self._starve(case)[1] for case in self.cases if not case.late)

    # -- the properties: each yields a trace if the case violates it -----------------------------

    def _no_single_decision(self, case: Case) -> Trace | None:
        taken = case.decision.recoveries
        again = self.strategy.choose(case.active, self.arrangement, case.late)
        known = self.arrangement.mechanisms.contracts
        if again != case.decision:
            return (case.describe(), "asked again, it decides otherwise")
        if not taken or not set(taken) <= known.keys() or len(set(taken)) != len(taken):
            return (case.describe(), "that is not a set of known recoveries, each once")
        exclusive = self.strategy.exclusive and not self.arrangement.compound
        if exclusive and len(taken) != 1:
            return (case.describe(), "a strategy that runs one at a time has to take one")
        return None

    def _conflicting_claims(self, case: Case) -> Trace | None:
        for one, other in combinations(case.decision.recoveries, 2):
            if self.arrangement.mechanisms.overlap(one, other):
                return (case.describe(), f"{one} and {other} claim the same resource")
        return None

    def _too_unsafe(self, case: Case) -> Trace | None:
        for name in case.active:
            for asked in self.arrangement.mechanisms.recover[name]:
                if not self._covered(asked, case.decision.recoveries):
                    return (case.describe(), f"{name} asks for {asked}, and nothing that runs is "
                                             "as safe")
        return None

    def _stop_not_taken(self, case: Case) -> Trace | None:
        root = self.arrangement.tree.root
        if root in case.active and not self.last_resort <= set(case.decision.recoveries):
            return (case.describe(), f"{root} asks for {listing(sorted(self.last_resort))}, the "
                                     "last resort, and it is not run")
        return None

    def _escalation_without_end(self, case: Case) -> Trace | None:
        recover = self.arrangement.mechanisms.recover
        contracts = self.arrangement.mechanisms.contracts
        for recovery in case.decision.recoveries:
            sakes = [n for n in case.decision.mechanisms if recovery in recover[n]]
            tried = succession(recovery, sakes or case.decision.mechanisms, contracts,
                               self.arrangement)
            if not self.last_resort & set(tried):
                return (case.describe(), f"if all fail: {' > '.join(tried)}, and the last resort "
                                         "is never tried")
        return None

    def _less_safe_with_more(self, case: Case) -> Trace | None:
        mechanisms = self.arrangement.mechanisms
        for extra in mechanisms.names:
            if extra in case.active:
                continue
            more = self._by_set[mechanisms.sort((*case.active, extra)), case.late]
            pair = case.decision.recoveries, more.decision.recoveries
            if pair not in self._milder:
                self._milder[pair] = self._find_milder(*pair)
            milder = self._milder[pair]
            if milder:
                return (case.describe(), more.describe(),
                        f"with {extra} active as well, {milder[1]} runs instead of {milder[0]}, "
                        "which is safer")
        return None

    def _find_milder(self, before: tuple[str, ...], after: tuple[str, ...]
                     ) -> tuple[str, str] | None:
        """Return a recovery that ran before, and a less safe one that runs instead of it.

        Compared is what is safest of each: repairs that run beneath make nothing less safe.
        """
        safest = self.safety.maximal(after)
        for had in self.safety.maximal(before):
            lower = [r for r in safest if self.safety.is_above(had, r)]
            if lower and not self._covered(had, safest):
                return had, lower[0]
        return None

    def _harm(self, case: Case) -> Trace | None:
        for one in case.decision.recoveries:
            for other in case.decision.recoveries:
                harmed = self.arrangement.mechanisms.harms(one, other)
                if harmed:
                    return (case.describe(), f"{one} disables {', '.join(sorted(harmed))}, which "
                                             f"{other} needs")
        return None

    def _starving_repair(self, case: Case) -> Trace | None:
        """Find a repair that is asked for and never run, though all recoveries succeed.

        Exempt is what starves while a latched last resort runs (`stuck_behind_last_resort`).
        """
        trace, behind = self._starve(case)
        return None if behind else trace

    def _starve(self, case: Case) -> tuple[Trace | None, bool]:
        """Return how a repair starves, if one does, and whether behind a latched last resort.

        What a repair is asked for persists until that repair has run, and so do the consequences
        that are detected above it. Everything else may go away by itself, and is let go.
        """
        recover = self.arrangement.mechanisms.recover
        contracts = self.arrangement.mechanisms.contracts
        repairs = {name for name, c in contracts.items() if c.kind.repairs}
        stops = {name for name in self.last_resort if contracts[name].latched}
        tree = self.arrangement.tree
        trace = [case.describe()]
        active = case.active
        while True:
            broken = [n for n in active if set(recover[n]) <= repairs]
            lasting = tuple(n for n in active if n in broken or any(
                tree.is_above(n, b) for b in broken))
            if not broken:
                return None, False
            decision = self._by_set[lasting, case.late.intersection(lasting)].decision
            if lasting != active:
                trace.append(f"what else was active goes away; {listing(lasting)} active: runs "
                             f"{listing(decision.recoveries)}")
            cured = {n for n in broken if set(recover[n]) <= set(decision.recoveries)}
            if not cured:
                waiting = listing(sorted({r for n in broken for r in recover[n]}))
                trace.append(f"{waiting} never runs, so {listing(broken)} stays active for ever")
                return tuple(trace), bool(stops.intersection(decision.recoveries))
            active = tuple(n for n in lasting if n not in cured)
            trace.append(f"{listing(decision.recoveries)} done")

    def _covered(self, recovery: str, by: tuple[str, ...]) -> bool:
        return any(one == recovery or self.safety.is_above(one, recovery) for one in by)


def order_agrees_with_tree(arrangement: Arrangement, safety: PartialOrder) -> Property:
    """Check that no mechanism's recovery is safer than that of a mechanism above it."""
    tree, recover = arrangement.tree, arrangement.mechanisms.recover
    pairs = [(upper, lower) for upper in tree.names
             for lower in tree.members(tree.below[tree.number[upper]])]

    def contradiction(pair: tuple[str, str]) -> Trace | None:
        upper, lower = pair
        for high in recover[lower]:
            for low in recover[upper]:
                if safety.is_above(high, low):
                    return (f"{upper} is above {lower} in the FTMTree, but {high} of {lower} is "
                            f"safer than {low} of {upper}",)
        return None

    return judge("order-agrees-with-tree", "", pairs, contradiction)


def judge(name: str, strategy: str, cases: list[T], find: Callable[[T], Trace | None]
          ) -> Property:
    """Look for counterexamples in all cases; keep the first few."""
    found = [trace for case in cases if (trace := find(case)) is not None]
    return Property(name, strategy, not found, len(cases), len(found), tuple(found[:KEPT]))


def subsets(names: Collection[str]) -> Iterator[tuple[str, ...]]:
    """Yield all sets of some names, the empty one first and smaller ones before larger."""
    return chain.from_iterable(combinations(names, size) for size in range(len(names) + 1))
