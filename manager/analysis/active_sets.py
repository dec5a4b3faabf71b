"""Checks what a strategy decides for every set of active mechanisms.

The check is exhaustive: all 2^n - 1 sets. For a patient strategy, each set is checked with every
subset of late mechanisms. Counterexamples are found smallest first.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from functools import cache, partial
from itertools import chain, combinations, product

import msgspec

from rampart.manager.model.order import PartialOrder, contradictions
from rampart.manager.strategies.arrangement import Arrangement
from rampart.manager.strategies.decision import Decision, Strategy
from rampart.manager.strategies.escalation import succession
from rampart.manager.strategies.registry import listing

MAX_MECHANISMS = 16
"""2^14 sets are checked in seconds, 2^16 in minutes; above that verification refuses."""

KEPT = 3
"""Counterexamples kept of each property; all are counted."""


class Property(msgspec.Struct, frozen=True):
    """The verdict on one property, see `docs/explanation/arbitration.md`.

    Attributes:
        strategy: Name of the strategy; "" if the property does not depend on one.
        cases: How many cases were checked.
        count: In how many of them it fails.
        counterexamples: The first few, shortest first; each is a trace, one line a step.
    """

    name: str
    strategy: str
    holds: bool
    cases: int
    count: int
    counterexamples: tuple[tuple[str, ...], ...]


Trace = tuple[str, ...]


class Case(msgspec.Struct, frozen=True):
    """What a strategy decides for one set of active and late mechanisms."""

    active: tuple[str, ...]
    late: frozenset[str]
    decision: Decision

    def describe(self) -> str:
        """Return one line: what is active, and what runs."""
        late = f", {listing(sorted(self.late))} late" if self.late else ""
        return (f"{listing(self.active)} active{late}: runs {listing(self.decision.recoveries)} "
                f"(rule {self.decision.rule})")


class ActiveSets:
    """All active sets of an arrangement under one strategy.

    `safety` is the order that defines which recovery is safer.
    """

    def __init__(self, arrangement: Arrangement, safety: PartialOrder, strategy: Strategy) -> None:
        self.arrangement = arrangement
        self.safety = safety
        self.strategy = strategy
        names = arrangement.mechanisms.names
        # Millions of cases share some thousand sets.
        late_set: Callable[[tuple[str, ...]], frozenset[str]] = cache(frozenset)
        self.cases = [
            Case(active, late, strategy.choose(active, arrangement, late))
            for active in subsets(names) if active
            for late in map(late_set, subsets(active) if strategy.patient else ((),))]
        self._by_set = {(case.active, case.late): case for case in self.cases}
        self._recover = arrangement.mechanisms.recover
        self._contracts = arrangement.mechanisms.contracts
        self.last_resort = frozenset(self._recover[arrangement.tree.root])
        # Of a bound method it would be a cycle, and millions of cases left to the collector.
        self._find_milder = cache(partial(_find_milder, safety))

    def check(self) -> Iterator[Property]:
        """Check every property."""
        for name, find in (
                ("one-decision", self._no_single_decision),
                ("no-conflicting-claims", self._conflicting_claims),
                ("safe-enough", self._too_unsafe),
                ("emergency-stop-at-once", self._stop_not_taken),
                ("escalation-ends", self._escalation_without_end),
                ("monotone", self._less_safe_with_more),
                ("no-harm", self._harm),
                ("repairs-run", self._starving_repair)):
            yield judge(name, self.strategy.name, len(self.cases), [
                (case.describe(), *wrong) for case in self.cases
                if (wrong := next(find(case), None))])

    @property
    def stops_for_good(self) -> int:
        """In how many sets a recovery runs that stays until an operator resets it."""
        return sum(any(self._contracts[r].latched for r in case.decision.recoveries)
                   for case in self.cases if not case.late)

    @property
    def stuck_behind_last_resort(self) -> int:
        """In how many sets a latched last resort runs, and a repair that is needed never does.

        `repairs-run` exempts these sets: the robot stands, and an operator has to come in any
        case. But the arbiter refuses the reset until the repair has been made by hand.
        """
        return sum(self._starve(case)[1] for case in self.cases if not case.late)

    # -- properties: each method yields what is wrong if the case violates it --------------------

    def _no_single_decision(self, case: Case) -> Iterator[Trace]:
        taken = case.decision.recoveries
        if self.strategy.choose(case.active, self.arrangement, case.late) != case.decision:
            yield ("the same question gets another answer",)
        if not taken or not set(taken) <= self._contracts.keys() or len(set(taken)) != len(taken):
            yield ("this is not a set of known recoveries, each listed once",)
        if self.strategy.exclusive and not self.arrangement.compound and len(taken) != 1:
            yield ("an exclusive strategy must run exactly one",)

    def _conflicting_claims(self, case: Case) -> Iterator[Trace]:
        for one, other in combinations(case.decision.recoveries, 2):
            if self.arrangement.mechanisms.overlap(one, other):
                yield (f"{one} and {other} claim the same resource",)

    def _too_unsafe(self, case: Case) -> Iterator[Trace]:
        for name in case.active:
            for asked in self._recover[name]:
                if not _is_covered(self.safety, asked, case.decision.recoveries):
                    yield (f"{name} asks for {asked}, and nothing that runs is as safe",)

    def _stop_not_taken(self, case: Case) -> Iterator[Trace]:
        root = self.arrangement.tree.root
        if root in case.active and not self.last_resort <= set(case.decision.recoveries):
            yield (f"{root} asks for {listing(sorted(self.last_resort))}, the last resort, and it "
                   "is not run",)

    def _escalation_without_end(self, case: Case) -> Iterator[Trace]:
        for recovery in case.decision.recoveries:
            sakes = [n for n in case.decision.mechanisms if recovery in self._recover[n]]
            tried = succession(recovery, sakes or case.decision.mechanisms, self._contracts,
                               self.arrangement)
            if not self.last_resort & set(tried):
                yield (f"if all fail: {' > '.join(tried)}, and the last resort is never tried",)

    def _less_safe_with_more(self, case: Case) -> Iterator[Trace]:
        mechanisms = self.arrangement.mechanisms
        for extra in mechanisms.names:
            if extra in case.active:
                continue
            more = self._by_set[mechanisms.sort((*case.active, extra)), case.late]
            milder = self._find_milder(case.decision.recoveries, more.decision.recoveries)
            if milder:
                yield more.describe(), (f"with {extra} active as well, {milder[1]} runs instead of "
                                        f"{milder[0]}, which is safer")

    def _harm(self, case: Case) -> Iterator[Trace]:
        for one, other in product(case.decision.recoveries, repeat=2):
            harmed = self.arrangement.mechanisms.harms(one, other)
            if harmed:
                yield (f"{one} disables {', '.join(sorted(harmed))}, which {other} needs",)

    def _starving_repair(self, case: Case) -> Iterator[Trace]:
        """Yield how a needed repair never runs, though all recoveries succeed.

        Sets in which a latched last resort runs are exempt (`stuck_behind_last_resort`).
        """
        trace, behind = self._starve(case)
        if trace and not behind:
            yield trace

    def _starve(self, case: Case) -> tuple[Trace, bool]:
        """Return how a repair starves, if one does, and whether behind a latched last resort.

        The cause of a repair persists until that repair has run, and so do the consequences that
        are detected above it. Everything else may disappear by itself, and does so here.
        """
        recover, tree = self._recover, self.arrangement.tree
        repairs = {name for name, c in self._contracts.items() if c.kind.repairs}
        stops = {name for name in self.last_resort if self._contracts[name].latched}
        trace: list[str] = []
        active = case.active
        while broken := [n for n in active if set(recover[n]) <= repairs]:
            lasting = tuple(n for n in active if n in broken or any(
                tree.is_above(n, b) for b in broken))
            decision = self._by_set[lasting, case.late.intersection(lasting)].decision
            if lasting != active:
                trace.append(f"what else was active goes away; {listing(lasting)} active: runs "
                             f"{listing(decision.recoveries)}")
            cured = {n for n in broken if set(recover[n]) <= set(decision.recoveries)}
            if not cured:
                waiting = listing(sorted({r for n in broken for r in recover[n]}))
                trace.append(f"{waiting} never runs, so {listing(broken)} stays active forever")
                return tuple(trace), bool(stops.intersection(decision.recoveries))
            active = tuple(n for n in lasting if n not in cured)
            trace.append(f"{listing(decision.recoveries)} done")
        return (), False

def _is_covered(safety: PartialOrder, recovery: str, by: tuple[str, ...]) -> bool:
    return any(other == recovery or safety.is_above(other, recovery) for other in by)


def _find_milder(safety: PartialOrder, before: tuple[str, ...], after: tuple[str, ...]
                 ) -> tuple[str, str] | None:
    """Return a recovery that ran before, and a less safe one that runs instead of it.

    Only the safest of each are compared: repairs that run beneath make nothing less safe.
    """
    safest = safety.maximal(after)
    for earlier in safety.maximal(before):
        lower = [recovery for recovery in safest if safety.is_above(earlier, recovery)]
        if lower and not _is_covered(safety, earlier, safest):
            return earlier, lower[0]
    return None


def order_agrees_with_tree(arrangement: Arrangement, safety: PartialOrder) -> Property:
    """Check that no mechanism's recovery is safer than that of a mechanism above it."""
    tree, recover = arrangement.tree, arrangement.mechanisms.recover
    found: dict[tuple[str, str], Trace] = {}
    for upper, lower, high, low in contradictions(tree, safety, recover):
        found.setdefault((upper, lower), (
            f"{upper} is above {lower} in the FTMTree, but {high} of {lower} is safer than {low} "
            f"of {upper}",))
    pairs = sum(below.bit_count() for below in tree.below)
    return judge("order-agrees-with-tree", "", pairs, list(found.values()))


def judge(name: str, strategy: str, cases: int, found: Sequence[Trace]) -> Property:
    """Return a property with the first few of its counterexamples."""
    return Property(name, strategy, not found, cases, len(found), tuple(found[:KEPT]))


def subsets(names: Collection[str], most: int | None = None) -> Iterator[tuple[str, ...]]:
    """Yield all subsets of some names, smaller ones first, of at most `most` names."""
    sizes = range(1 + (len(names) if most is None else most))
    return chain.from_iterable(combinations(names, size) for size in sizes)
