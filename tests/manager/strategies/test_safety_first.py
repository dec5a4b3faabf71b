"""Safety-first against an oracle written from the paper's words, for all 127 active sets."""

from itertools import combinations

import pytest

from rampart.manager.model.order import UnknownElementError
from rampart.manager.strategies.registry import (
    STRATEGIES,
    UnknownStrategyError,
    decide,
    find_strategy,
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


@pytest.mark.parametrize(("active", "block", "executed"), [
    (["FTM7"], 1, "RM4"),
    (["FTM1", "FTM6"], 2, "RM1"),
    (["FTM3", "FTM4"], 3, "RM2"),
    (["FTM2", "FTM6", "FTM5"], 4, "RM1"),
])
def test_table_iii_of_the_paper(active, block, executed):
    decision = decide(active, MECHANISMS, TREE, ORDER)
    assert (block, (executed,)) == (decision.rule, decision.recoveries)


def test_what_is_unknown_is_named_with_what_is_known_and_nothing_active_needs_nothing():
    with pytest.raises(UnknownElementError, match=r"unknown mechanism 'FTM9'; known: FTM1, FTM2"):
        decide(["FTM1", "FTM9"], MECHANISMS, TREE, ORDER)
    with pytest.raises(UnknownStrategyError, match=r"unknown strategy 'bold'; known: .*safety-f"):
        find_strategy("bold")
    nothing = decide([], MECHANISMS, TREE, ORDER)
    assert (nothing.rule, nothing.recoveries) == (0, ())


def test_a_strategy_is_added_by_its_name(monkeypatch):
    monkeypatch.setitem(STRATEGIES, "test-only", SafetyFirst())
    assert decide(["FTM7"], MECHANISMS, TREE, ORDER, "test-only").recoveries == ("RM4",)
