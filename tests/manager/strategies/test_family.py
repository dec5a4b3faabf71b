"""Every strategy on random small systems, against oracles written from the docstrings alone."""

from itertools import chain, combinations, pairwise, permutations, product
from typing import NamedTuple

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rampart.manager.model.mechanisms import Contract, Mechanism, Mechanisms, RecoveryKind
from rampart.manager.model.order import CycleError, PartialOrder, Tree, UnknownElementError, refine
from rampart.manager.strategies.arrangement import Arrangement
from rampart.manager.strategies.guarded_repair import GuardedRepair
from rampart.manager.strategies.mission_first import MissionFirst
from rampart.manager.strategies.registry import STRATEGIES, UnknownStrategyError, decide
from rampart.manager.strategies.safety_first import SafetyFirst
from rampart.manager.strategies.simultaneous import Simultaneous
from tests.manager.bench import closure, paper

NOBODY = frozenset()


class System(NamedTuple):
    """A system, and what follows from it, found by brute force: the oracles use nothing else."""

    arrangement: Arrangement
    parents: dict[str, str | None]
    above: set[tuple[str, str]]  # of recoveries, transitively closed
    recover: dict[str, tuple[str, ...]]
    contracts: dict[str, Contract]

    def up(self, ftm: str) -> list[str]:
        """The mechanism and all those above it, the nearest first."""
        names = [ftm]
        while (parent := self.parents[names[-1]]) is not None:
            names.append(parent)
        return names

    def dominates(self, upper: str, lower: str) -> bool:
        return upper in self.up(lower)

    def common(self, ftms) -> str:
        """The lowest common dominant."""
        ways = [self.up(ftm) for ftm in ftms]
        return next(name for name in ways[0] if all(name in way for way in ways))

    def covers(self, one: str, other: str) -> bool:
        return one == other or (one, other) in self.above

    def compatible(self, recoveries) -> bool:
        return not any(
            self.contracts[a].claims & self.contracts[b].claims
            or self.contracts[a].disables & self.contracts[b].needs
            for a, b in permutations(recoveries, 2))

    def asked(self, ftms) -> list[str]:
        return list(dict.fromkeys(chain.from_iterable(self.recover[ftm] for ftm in ftms)))

    def is_repair(self, recovery: str) -> bool:
        return self.contracts[recovery].kind is not RecoveryKind.FORWARD


@st.composite
def systems(draw, *, largest: int = 7) -> System:
    """A random tree, and a random order that does not contradict it."""
    ftms = [f"F{i}" for i in range(draw(st.integers(1, largest)))]
    names = [f"R{i}" for i in range(draw(st.integers(1, 6)))]
    shuffled = draw(st.permutations(ftms))
    parents: dict[str, str | None] = {shuffled[0]: None}
    for i, ftm in enumerate(shuffled[1:], start=1):
        parents[ftm] = shuffled[draw(st.integers(0, i - 1))]
    parents = {ftm: parents[ftm] for ftm in ftms}
    some = st.frozensets(st.sampled_from("xyz"), max_size=2)
    contracts = {name: Contract(
        name, draw(st.sampled_from(RecoveryKind)), draw(some), latched=draw(st.booleans()),
        needs=draw(st.frozensets(st.sampled_from("nm"), max_size=1)),
        disables=draw(st.frozensets(st.sampled_from("n"), max_size=1))) for name in names}
    plain = System(None, parents, set(), {}, contracts)
    ways = [(name,) for name in names] + [
        pair for pair in permutations(names, 2) if plain.compatible(pair)]
    recover = {ftm: draw(st.sampled_from(ways)) for ftm in ftms}
    forbidden = {(low, high) for lower in ftms for upper in plain.up(lower)[1:]
                 for low, high in product(recover[lower], recover[upper])}
    above: set[tuple[str, str]] = set()
    places = draw(st.permutations(names))
    for a, b in combinations(places, 2):
        wider = closure(above | {(a, b)}) if draw(st.booleans()) else above
        if not wider & forbidden:
            above = wider
    arrangement = Arrangement(
        Mechanisms([Mechanism(ftm, f"D{i}", " and ".join(recover[ftm]))
                    for i, ftm in enumerate(ftms)], list(contracts.values())),
        Tree(parents),
        PartialOrder(names, {a: [b for x, b in sorted(above) if x == a] for a in names}))
    return System(arrangement, parents, above, recover, contracts)


@st.composite
def questions(draw) -> tuple[System, tuple[str, ...]]:
    system = draw(systems())
    active = draw(st.sets(st.sampled_from(sorted(system.parents)), min_size=1))
    return system, tuple(sorted(active))


# ---- safety-first -----------------------------------------------------------------------------


def safety_first(system: System, active) -> tuple[int, tuple[str, ...]]:
    if len(active) == 1:
        return 1, system.recover[active[0]]
    for ftm in active:
        if all(system.dominates(ftm, other) for other in active):
            return 2, system.recover[ftm]
    asked = system.asked(active)
    for one in asked:
        if all(system.covers(one, other) for other in asked):
            return 3, (one,)
    for ftm in active:  # a compound recovery dominates by any of its parts
        if all(any(system.covers(one, other) for one in system.recover[ftm]) for other in asked):
            return 3, system.recover[ftm]
    return 4, system.recover[system.common(active)]


@given(questions())
def test_safety_first_follows_the_four_blocks(question):
    system, active = question
    decision = SafetyFirst().choose(active, system.arrangement, NOBODY)
    assert (decision.rule, decision.recoveries) == safety_first(system, active)


SPEC = paper()
PAPER = Arrangement(SPEC.build_mechanisms(), SPEC.build_ftm_tree(), SPEC.build_order())
# Figure 8 of the paper and its list of mechanisms, by hand: the oracle reads no specification.
BY_HAND = System(
    PAPER,
    {"FTM1": None, "FTM2": "FTM1", "FTM3": "FTM1", "FTM6": "FTM1", "FTM4": "FTM2", "FTM5": "FTM2",
     "FTM7": "FTM6"},
    closure({("RM1", "RM2"), ("RM1", "RM5"), ("RM2", "RM3"), ("RM2", "RM4"), ("RM5", "RM3"),
             ("RM5", "RM4")}),
    {"FTM1": ("RM1",), "FTM2": ("RM2",), "FTM3": ("RM2",), "FTM4": ("RM3",), "FTM5": ("RM4",),
     "FTM6": ("RM5",), "FTM7": ("RM4",)}, {})


@pytest.mark.parametrize("active", [
    active for size in range(1, 8) for active in combinations(BY_HAND.parents, size)],
    ids="+".join)
def test_every_active_set_of_the_paper_s_system_is_decided_as_the_paper_says(active):
    decision = decide(active, PAPER.mechanisms, PAPER.tree, PAPER.order)
    assert (decision.rule, decision.recoveries) == safety_first(BY_HAND, active)
    assert decision.active == tuple(sorted(active))


def test_what_is_unknown_is_named_with_what_is_known_and_nothing_active_needs_nothing():
    paper_s = PAPER.mechanisms, PAPER.tree, PAPER.order
    with pytest.raises(UnknownElementError, match=r"unknown mechanism 'FTM9'; known: FTM1, FTM2"):
        decide(["FTM1", "FTM9"], *paper_s)
    with pytest.raises(UnknownStrategyError, match=r"unknown strategy 'bold'; known: .*safety-f"):
        decide(["FTM1"], *paper_s, "bold")
    nothing = decide([], *paper_s)
    assert (nothing.rule, nothing.recoveries) == (0, ())


# ---- simultaneous -----------------------------------------------------------------------------


def simultaneous(system: System, active) -> tuple[int, set[str]]:
    rule, sakes = (1 if len(active) == 1 else 2), set(active)
    while True:
        asked = system.asked(sorted(sakes))
        if len(sakes) == 1:
            return rule, set(asked)
        maximal = [r for r in asked if not any((o, r) in system.above for o in asked)]
        clash = {r for pair in combinations(maximal, 2) if not system.compatible(pair)
                 for r in pair}
        if not clash:
            return rule, set(maximal)
        involved = [ftm for ftm in sakes if clash & set(system.recover[ftm])]
        upper = system.common(involved)
        sakes = {upper} | {ftm for ftm in sakes if not system.dominates(upper, ftm)}
        rule = 3


@given(questions())
def test_simultaneous_runs_all_that_nothing_dominates_as_far_as_it_can(question):
    system, active = question
    decision = Simultaneous().choose(active, system.arrangement, NOBODY)
    rule, recoveries = simultaneous(system, active)
    assert (decision.rule, set(decision.recoveries)) == (rule, recoveries)
    assert system.compatible(decision.recoveries)


# ---- guarded-repair ---------------------------------------------------------------------------


def guard_of(system: System, active) -> tuple[int, tuple[str, ...]]:
    asked = system.asked(active)
    if len(active) == 1:
        return 1, system.recover[active[0]]
    for one in asked:
        if all(system.covers(one, other) for other in asked):
            return 2, (one,)
    bounds = [r for r in system.contracts if all(system.covers(r, other) for other in asked)]
    least = [r for r in bounds if not any((r, o) in system.above for o in bounds)]
    upper = system.recover[system.common(active)]
    if not least:
        return 4, upper
    return 3, (next((r for r in upper if r in least), least[0]),)


@given(questions())
def test_the_guard_is_the_least_that_is_safer_than_all_and_repairs_run_or_wait_for_a_conflict(
        question):
    system, active = question
    decision = GuardedRepair().choose(active, system.arrangement, NOBODY)
    rule, guard = guard_of(system, active)
    taken = decision.recoveries
    assert (decision.rule, taken[:len(guard)]) == (rule, guard)
    assert all(system.is_repair(r) and r in system.asked(active) for r in taken[len(guard):])
    assert system.compatible(taken)
    assert len(set(taken)) == len(taken)
    for repair in filter(system.is_repair, system.asked(active)):
        assert repair in taken or not system.compatible((*taken, repair))


# ---- mission-first ----------------------------------------------------------------------------


def mission_first(system: System, active, late) -> tuple[int, set[str], set[str]]:
    """Rule, mechanisms that ask, and what they ask for, before conflicts are resolved."""
    roots = [ftm for ftm in active if system.parents[ftm] is None]
    if roots:
        return 3, set(roots), set(system.recover[roots[0]])
    asking = set()
    for ftm in active:
        if any(o != ftm and o not in late and system.dominates(ftm, o) for o in active):
            continue
        # Up from itself, past all that are late; what is not active is not late.
        asking.add(next(n for n in system.up(ftm) if n not in late or not system.parents[n]))
    top = {ftm for ftm in asking
           if not any(o != ftm and system.dominates(o, ftm) for o in asking)}
    return (2 if late else 1), top, set(system.asked(sorted(top)))


@given(questions(), st.data())
def test_mission_first_takes_the_deepest_barriers_that_are_in_time(question, data):
    system, active = question
    late = frozenset(data.draw(st.sets(st.sampled_from(active))))
    decision = MissionFirst().choose(active, system.arrangement, late)
    rule, asking, asked = mission_first(system, active, late)
    taken = decision.recoveries
    assert decision.rule == rule
    assert taken
    assert set(taken) <= asked
    assert set(decision.mechanisms) <= asking
    assert system.compatible(taken)
    for one in asked - set(taken):  # it gave way to one in conflict, and not to a lower one
        assert any(not system.compatible((one, o)) and (one, o) not in system.above
                   for o in taken)


@given(questions(), st.sampled_from(sorted(STRATEGIES)), st.data())
def test_every_certificate_holds_and_leaves_nothing_unsaid(question, name, data):
    """Each chain is one of dominance; what was asked for is taken, or rejected with a reason."""
    system, active = question
    late = frozenset(data.draw(st.sets(st.sampled_from(active))))
    strategy = STRATEGIES[name]
    chosen = strategy.choose(active, system.arrangement, late)
    decision = strategy.explain(chosen, system.arrangement)
    assert (decision.active, decision.rule, decision.recoveries, decision.mechanisms) == (
        chosen.active, chosen.rule, chosen.recoveries, chosen.mechanisms)
    assert decision.rule in strategy.rules
    assert decision.path
    for links in (line.split(" > ") for line in decision.path):
        for upper, lower in pairwise(links):
            assert (upper, lower) in system.above or system.dominates(upper, lower)
    rejected = {subject for subject, _ in decision.rejected}
    assert not rejected & set(decision.recoveries)
    assert all(why for _, why in decision.rejected)
    if decision.rule != 1:
        assert set(system.asked(active)) <= rejected | set(decision.recoveries)


# ---- orders of several criteria ---------------------------------------------------------------


LETTERS = "abcde"
PAIRS = st.tuples(st.permutations(LETTERS), st.sets(st.sampled_from(
    list(combinations(range(5), 2))))).map(
        lambda d: closure({(d[0][i], d[0][j]) for i, j in d[1]}))


def order_of(pairs) -> PartialOrder:
    return PartialOrder(LETTERS, {a: [b for x, b in sorted(pairs) if x == a] for a in LETTERS})


@given(st.lists(PAIRS, min_size=1, max_size=3))
def test_a_criterion_decides_only_what_those_before_it_leave_open(criteria):
    expected = set(criteria[0])
    for pairs in criteria[1:]:
        expected = closure(expected | {(a, b) for a, b in pairs if (b, a) not in expected})
        if any((a, a) in expected for a in LETTERS):
            with pytest.raises(CycleError):
                refine([order_of(p) for p in criteria])
            return
    refined = refine([order_of(p) for p in criteria])
    found = {(a, b) for a, b in permutations(LETTERS, 2) if refined.is_above(a, b)}
    assert found == expected
    assert criteria[0] <= found  # the first is never contradicted
