"""Verifies a system's arbitration: every active set, every reachable state.

`verify` combines the verdicts of `rampart.manager.analysis.active_sets` on decisions with those of
`rampart.manager.analysis.transitions` on their execution. `docs/explanation/arbitration.md`
explains each property, and what it found about the paper's strategy.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from itertools import combinations, permutations, product

import msgspec

from rampart.manager.analysis.active_sets import (
    KEPT,
    MAX_MECHANISMS,
    ActiveSets,
    Property,
    Trace,
    order_agrees_with_tree,
    subsets,
)
from rampart.manager.analysis.transitions import Transitions, Violations, explore
from rampart.manager.model.mechanisms import Clears
from rampart.manager.spec.budget import patience_s
from rampart.manager.spec.schema import SystemSpec
from rampart.manager.strategies.arrangement import Arrangement
from rampart.manager.strategies.decision import Decision
from rampart.manager.strategies.escalation import escalate
from rampart.manager.strategies.registry import STRATEGIES, find_strategy

MEANING = {
    "one-decision": "there is always exactly one decision",
    "no-conflicting-claims": "no two recoveries hold the same resource",
    "safe-enough": "what runs is at least as safe as what each active mechanism asks for",
    "emergency-stop-at-once": "the last resort never waits for anything",
    "escalation-ends": "if everything fails, the last resort is tried",
    "recovery-ends": "every recovery that was started ends or escalates",
    "none-cut-off": "no recovery is released half-way",
    "cleared-as-specified": "what clears by operator waits for a reset; what never clears stays",
    "monotone": "one more active mechanism never leads to a less safe recovery",
    "no-harm": "no recovery disables what it or another one needs",
    "repairs-run": "a needed repair runs at some time, unless the last resort latches",
    "order-agrees-with-tree": "no mechanism is safer than one above it",
}
"""Names of the properties, each with its meaning in one line."""

_ALL_FAILURES_OF = 10
"""Of up to this many recoveries that escalation can lead to, any combination may have failed."""

_FAILURES_AT_ONCE = 3
"""Of more recoveries, at most this many."""

Progress = Callable[[str], None]


class Report(msgspec.Struct, frozen=True):
    """What verification found.

    Attributes:
        strategy: The strategy that the system uses.
        active_sets: How many sets of active mechanisms were checked for each strategy.
        states: How many states of the arbiter were visited, over all strategies.
        permissiveness: For each strategy, in how many active sets the robot must stop until
            an operator resets it.
        stuck_behind_last_resort: For each strategy, in how many active sets a latched last resort
            runs and a repair that is needed never does; `repairs-run` exempts these.
        properties: The system's strategy first.
    """

    system: str
    strategy: str
    active_sets: int
    states: int
    permissiveness: dict[str, int]
    stuck_behind_last_resort: dict[str, int]
    properties: tuple[Property, ...]


class TooLargeError(ValueError):
    """A system with more active sets than can be checked."""


def verify(spec: SystemSpec, strategies: Iterable[str] = (), together: int = 2,
           progress: Progress = lambda _: None) -> Report:
    """Check every property of some strategies on a system.

    Args:
        spec: The system.
        strategies: Names; all of them, the system's own first, if none is given.
        together: How many recoveries to explore at a time; two suffice
            (`rampart.manager.analysis.transitions`).
        progress: Called with a line on each step.

    Raises:
        TooLargeError: The system has too many mechanisms.
        UnknownStrategyError: No such strategy.
    """
    count = 2 ** len(spec.mechanisms) - 1
    if len(spec.mechanisms) > MAX_MECHANISMS:
        raise TooLargeError(
            f"{spec.name}: {len(spec.mechanisms)} mechanisms have {count} active sets; at most "
            f"{MAX_MECHANISMS} mechanisms can be verified exhaustively")
    names = tuple(strategies) or tuple(dict.fromkeys((spec.strategy, *STRATEGIES)))
    arrangement = Arrangement(
        spec.build_mechanisms(patience_s(spec)), spec.build_ftm_tree(), spec.build_order())
    safety = spec.build_safety_order()
    explorer = _Explorer(arrangement, together)
    properties = [order_agrees_with_tree(arrangement, safety)]
    permissiveness, stuck = {}, {}
    for name in names:
        progress(f"{name}: {count} active sets")
        sets = ActiveSets(arrangement, safety, find_strategy(name))
        permissiveness[name] = sets.stops_for_good
        stuck[name] = sets.stuck_behind_last_resort
        statically = {p.name: p for p in sets.check()}
        states, violations = 0, list[tuple[str, Trace]]()
        for what, visited, found in explorer.run(sets):
            progress(f"{name}: {what}, {visited} states")
            states += visited
            violations += found.items()
        properties += _merge(name, statically, states, violations)
    return Report(spec.name, spec.strategy, count, explorer.states, permissiveness, stuck,
                  tuple(properties))


_OF_STATES = ("one-decision", "no-conflicting-claims", "emergency-stop-at-once", "recovery-ends",
              "none-cut-off", "cleared-as-specified")


def _merge(strategy: str, statically: dict[str, Property], states: int,
           violations: list[tuple[str, Trace]]) -> Iterator[Property]:
    """Yield one verdict a property, over sets and states if it was checked on both."""
    for name in MEANING:
        if name in _OF_STATES:
            base = statically.get(name, Property(name, strategy, True, 0, 0, ()))
            found = sorted((trace for failed, trace in violations if failed == name), key=len)
            yield Property(name, strategy, base.holds and not found, base.cases + states,
                           base.count + len(found), (*base.counterexamples, *found)[:KEPT])
        elif name in statically:
            yield statically[name]


class _Explorer:
    """Explores the recoveries of a system; equal transition systems only once."""

    def __init__(self, arrangement: Arrangement, together: int) -> None:
        self.arrangement = arrangement
        self.together = together
        self.states = 0
        self._explored: dict[object, tuple[int, Violations]] = {}
        self._urgent = frozenset(arrangement.mechanisms.recover[arrangement.tree.root])

    def run(self, sets: ActiveSets) -> Iterator[tuple[str, int, Violations]]:
        """Yield the names, the number of states and the violations of each choice of recoveries."""
        asked = _askable(sets)
        names = self.arrangement.mechanisms.recoveries
        exclusive = sets.strategy.exclusive and not self.arrangement.compound
        mechanisms = self.arrangement.mechanisms
        for name, deaths in product(names, (True, False)):
            # Whether a mechanism clears as specified concerns it and its recovery alone.
            for clears in {mechanisms.by_name[user].clears: None for user in sorted(
                    mechanisms.users[name])} or (Clears.BY_ITSELF,):
                yield self._explore((name,), asked, exclusive=exclusive, clears=clears,
                                    with_modules=True, deaths=deaths)
        size = min(self.together, len(names))
        for chosen in combinations(names, size) if size > 1 else ():
            yield self._explore(chosen, asked, exclusive=exclusive)

    def _explore(self, names: tuple[str, ...], asked: frozenset[frozenset[str]], *,
                 exclusive: bool, clears: Clears = Clears.BY_ITSELF, with_modules: bool = False,
                 deaths: bool = True) -> tuple[str, int, Violations]:
        mechanisms, order = self.arrangement.mechanisms, self.arrangement.order
        # A recovery outside may make one of these wait, as if it were not asked for yet.
        here = frozenset(
            frozenset(part) for taken in asked for part in subsets(taken.intersection(names)))
        shape = _shape(names, here, self._urgent, self.arrangement)
        key = (shape, exclusive, clears, with_modules, deaths)
        if key not in self._explored:
            contracts = [mechanisms.contracts[n] for n in names]
            self._explored[key] = explore(Transitions(
                contracts, order, here, self._urgent.intersection(names), exclusive=exclusive,
                clears=clears, with_modules=with_modules, deaths=deaths))
            self.states += self._explored[key][0]
        return " and ".join(names), *self._explored[key]


def _askable(sets: ActiveSets) -> frozenset[frozenset[str]]:
    """Return the sets of recoveries that a strategy can ask for, also after escalations."""
    arrangement = sets.arrangement
    decisions = {(c.decision.recoveries, c.decision.mechanisms): c.decision for c in sets.cases}
    found = set()
    for decision in decisions.values():
        reachable = _reachable(decision, arrangement)
        concerned = [n for n in arrangement.mechanisms.recoveries if n in reachable]
        most = len(concerned) if len(concerned) <= _ALL_FAILURES_OF else _FAILURES_AT_ONCE
        for failed in subsets(concerned, most):
            if not failed or set(failed).intersection(decision.recoveries):
                found.add(frozenset(escalate(
                    decision, dict.fromkeys(failed, "failed"), arrangement).recoveries))
    return frozenset(found)


def _reachable(decision: Decision, arrangement: Arrangement) -> set[str]:
    """Return all recoveries that a decision and its escalations can lead to."""
    tree, contracts = arrangement.tree, arrangement.mechanisms.contracts
    found = set(decision.recoveries)
    for mechanism in decision.mechanisms:
        found.update(*arrangement.mechanisms.alternatives(mechanism),
                     arrangement.demanded(tree.chain(tree.root, mechanism)))
    for name in list(found):
        while (name := contracts[name].escalate_to) and name not in found:
            found.add(name)
    return found


def _shape(names: tuple[str, ...], asked: frozenset[frozenset[str]], urgent: frozenset[str],
           arrangement: Arrangement) -> object:
    """Return a key that is equal for choices of recoveries that behave alike."""
    if len(names) > 3:
        return names, asked
    return min((_profile(some, asked, urgent, arrangement) for some in permutations(names)),
               key=repr)


def _profile(names: tuple[str, ...], asked: frozenset[frozenset[str]], urgent: frozenset[str],
             arrangement: Arrangement) -> object:
    mechanisms, order = arrangement.mechanisms, arrangement.order
    number = {name: i for i, name in enumerate(names)}
    alone = tuple(
        (c.kind.repairs, c.interruptible, c.latched, bool(c.excused_by),
         number.get(c.escalate_to, -1), n in urgent)
        for n in names for c in [mechanisms.contracts[n]])
    pairs = tuple((order.is_above(a, b), mechanisms.overlap(a, b), bool(mechanisms.harms(a, b)))
                  for a, b in permutations(names, 2))
    return alone, pairs, tuple(sorted(tuple(sorted(number[n] for n in taken)) for taken in asked))
