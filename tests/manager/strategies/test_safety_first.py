"""Safety-first against an oracle written from the paper's words, for all 127 active sets."""

from itertools import combinations, pairwise

import pytest

from rampart.manager.model.order import UnknownElementError
from rampart.manager.strategies.registry import (
    STRATEGIES,
    UnknownStrategyError,
    decide,
    find_strategy,
    register,
)
from rampart.manager.strategies.safety_first import SafetyFirst
from tests.manager.bench import paper

SPEC = paper()
MECHANISMS, TREE, ORDER = SPEC.build_mechanisms(), SPEC.build_ftm_tree(), SPEC.build_order()

# The paper's figure 8 and its list of FTMs, once more by hand: the oracle reads no TOML.
EDGES = [("FTM1", "FTM6"), ("FTM1", "FTM2"), ("FTM1", "FTM3"),
         ("FTM6", "FTM7"), ("FTM2", "FTM4"), ("FTM2", "FTM5")]
SAFER = [("RM1", "RM2"), ("RM1", "RM5"), ("RM2", "RM3"), ("RM2", "RM4"), ("RM5", "RM3"),
         ("RM5", "RM4")]
RECOVERY = {"FTM1": "RM1", "FTM2": "RM2", "FTM3": "RM2", "FTM4": "RM3", "FTM5": "RM4",
            "FTM6": "RM5", "FTM7": "RM4"}
FTMS = sorted(RECOVERY)
ALL_SETS = [set(c) for n in range(1, 8) for c in combinations(FTMS, n)]


def paths_from_root(target: str) -> list[list[str]]:
    """Every path from FTM1 to the target, found by walking the edges."""
    found, unfinished = [], [["FTM1"]]
    while unfinished:
        path = unfinished.pop()
        if path[-1] == target:
            found.append(path)
        unfinished += [[*path, low] for up, low in EDGES if up == path[-1]]
    return found


def dominates_in_tree(x: str, y: str) -> bool:
    """"FTMx dominates FTMy if every path from the root node to FTMy goes through FTMx.\""""
    return all(x in path for path in paths_from_root(y))


def warshall(pairs: list[tuple[str, str]]) -> set[tuple[str, str]]:
    names = sorted({name for pair in pairs for name in pair})
    closed = set(pairs)
    for middle in names:
        for a in names:
            for b in names:
                if (a, middle) in closed and (middle, b) in closed:
                    closed.add((a, b))
    return closed


IS_SAFER = warshall(SAFER)


def oracle(active: set[str]) -> tuple[int, str]:
    """The four blocks of figure 7, read aloud."""
    if len(active) == 1:
        return 1, RECOVERY[next(iter(active))]
    dominant = [x for x in active if all(dominates_in_tree(x, y) for y in active)]
    if dominant:
        return 2, RECOVERY[dominant[0]]
    recoveries = {RECOVERY[x] for x in active}
    safest = [r for r in recoveries if all((r, o) in IS_SAFER for o in recoveries - {r})]
    if safest:
        return 3, safest[0]
    common = [x for x in FTMS if all(dominates_in_tree(x, y) for y in active)]
    lowest = [x for x in common if all(dominates_in_tree(y, x) for y in common)]
    return 4, RECOVERY[lowest[0]]


@pytest.mark.parametrize("active", ALL_SETS, ids=lambda s: "+".join(sorted(s)))
def test_every_active_set_is_decided_as_the_paper_says(active):
    decision = decide(active, MECHANISMS, TREE, ORDER)
    assert oracle(active) == (decision.rule, decision.recoveries[0])
    assert len(decision.recoveries) == 1
    assert tuple(sorted(active)) == decision.active


def test_the_oracle_meets_all_four_blocks():
    counts = {block: sum(oracle(s)[0] == block for s in ALL_SETS) for block in (1, 2, 3, 4)}
    assert sum(counts.values()) == 127
    assert all(counts.values())


@pytest.mark.parametrize(("active", "block", "executed"), [
    (["FTM7"], 1, "RM4"),
    (["FTM1", "FTM6"], 2, "RM1"),
    (["FTM3", "FTM4"], 3, "RM2"),
    (["FTM2", "FTM6", "FTM5"], 4, "RM1"),
])
def test_table_iii_of_the_paper(active, block, executed):
    decision = decide(active, MECHANISMS, TREE, ORDER)
    assert (block, (executed,)) == (decision.rule, decision.recoveries)


@pytest.mark.parametrize(("active", "executed"), [
    (["FTM5", "FTM7"], "RM4"), (["FTM2", "FTM3"], "RM2"),
])
def test_two_mechanisms_that_share_a_recovery_run_it_by_block_3(active, executed):
    decision = decide(active, MECHANISMS, TREE, ORDER)
    assert (3, (executed,)) == (decision.rule, decision.recoveries)
    assert tuple(active) == decision.mechanisms


def test_nothing_active_means_nothing_to_do():
    decision = decide([], MECHANISMS, TREE, ORDER)
    assert (decision.rule, decision.recoveries) == (0, ())


@pytest.mark.parametrize("active", ALL_SETS, ids=lambda s: "+".join(sorted(s)))
def test_the_certificate_holds_for_every_active_set(active):
    """Each chain is one of dominance, and each alternative is either taken or rejected."""
    decision = decide(active, MECHANISMS, TREE, ORDER)
    for chain in decision.path:
        links = chain.split(" > ")
        for upper, lower in pairwise(links):
            assert dominates_in_tree(upper, lower) if upper.startswith("FTM") \
                else (upper, lower) in IS_SAFER
    if decision.rule in {2, 4}:
        assert active - set(decision.mechanisms) == {
            chain.split(" > ")[-1] for chain in decision.path}
    rejected = {name for name, _ in decision.rejected}
    assert {RECOVERY[x] for x in active} <= rejected | set(decision.recoveries)
    assert not rejected & set(decision.recoveries)
    assert all(why for _, why in decision.rejected)


def test_the_certificate_reads_like_an_explanation():
    decision = decide(["FTM2", "FTM6", "FTM5"], MECHANISMS, TREE, ORDER)
    assert decision.path == ("FTM1 > FTM2", "FTM1 > FTM2 > FTM5", "FTM1 > FTM6")
    assert ("RM5", "does not dominate RM2") in decision.rejected


def test_an_unknown_mechanism_is_named_with_those_that_are_known():
    with pytest.raises(UnknownElementError, match=r"unknown mechanism 'FTM9'; known: FTM1, FTM2"):
        decide(["FTM1", "FTM9"], MECHANISMS, TREE, ORDER)


def test_an_unknown_strategy_is_named_with_those_that_are_known():
    with pytest.raises(UnknownStrategyError, match=r"unknown strategy 'bold'; known: .*safety-f"):
        find_strategy("bold")


def test_a_strategy_can_be_added_but_not_replaced_by_accident():
    class Mine(SafetyFirst):
        name = "test-only"

    try:
        register(Mine())
        assert decide(["FTM7"], MECHANISMS, TREE, ORDER, Mine.name).recoveries == ("RM4",)
        with pytest.raises(ValueError, match="registered twice"):
            register(Mine())
    finally:
        STRATEGIES.pop(Mine.name, None)
