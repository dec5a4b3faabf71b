"""Orders and trees: the paper's examples, and Warshall's closure as an oracle."""

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rampart.manager.model.order import (
    CycleError,
    PartialOrder,
    Tree,
    UnknownElementError,
    find_cycle,
)
from tests.manager.bench import paper

RM_ORDER = paper().build_order()
FTM_TREE = paper().build_ftm_tree()


def test_a_chain_skips_nothing_that_lies_between():
    assert FTM_TREE.chain("FTM1", "FTM7") == ("FTM1", "FTM6", "FTM7")
    with pytest.raises(ValueError, match="FTM7 is not above FTM1"):
        FTM_TREE.chain("FTM7", "FTM1")


def test_a_cycle_is_named_all_the_way_round():
    with pytest.raises(CycleError, match="cycle a > b > c > a") as caught:
        PartialOrder("abc", {"a": "b", "b": "c", "c": "a"})
    assert caught.value.cycle == ("a", "b", "c", "a")
    assert find_cycle({"a": ["a"]}) == ("a", "a")
    names = [f"n{i}" for i in range(5000)]
    assert find_cycle({a: [b] for a, b in pairwise(names)}) is None
    with pytest.raises(UnknownElementError, match="unknown 'RM9'; known: RM1, RM2"):
        RM_ORDER.greatest({"RM1", "RM9"})


NAMES = "abcdefg"
# Random acyclic relations: pairs only go from a letter to a later one in a random permutation.
RELATIONS = st.tuples(
    st.permutations(NAMES),
    st.sets(st.tuples(st.integers(0, 6), st.integers(0, 6)).filter(lambda p: p[0] < p[1])))


@given(RELATIONS, st.sets(st.sampled_from(NAMES)))
def test_any_order_agrees_with_warshall(relation, members):
    letters, pairs = relation
    reach = [[(i, j) in pairs for j in range(7)] for i in range(7)]
    for k in range(7):
        for i in range(7):
            for j in range(7):
                reach[i][j] = reach[i][j] or (reach[i][k] and reach[k][j])
    at = {letter: i for i, letter in enumerate(letters)}
    above: dict[str, list[str]] = {}
    for i, j in pairs:
        above.setdefault(letters[i], []).append(letters[j])
    order = PartialOrder(NAMES, above)
    for a in NAMES:
        for b in NAMES:
            assert reach[at[a]][at[b]] == order.is_above(a, b)
    greatest = [a for a in members if all(a == b or reach[at[a]][at[b]] for b in members)]
    assert (greatest[0] if greatest else None) == order.greatest(members)
    assert {a for a in members if not any(reach[at[b]][at[a]] for b in members)} == set(
        order.maximal(members))


@given(st.lists(st.integers(0, 100), min_size=6, max_size=6), st.data())
def test_the_lowest_common_dominant_of_any_tree_agrees_with_walking_up(choices, data):
    parents: dict[str, str | None] = {"n0": None}
    for i, choice in enumerate(choices, start=1):
        parents[f"n{i}"] = f"n{choice % i}"
    members = data.draw(st.sets(st.sampled_from(sorted(parents)), min_size=1))

    def up(name: str) -> list[str]:
        return [name, *(up(parents[name]) if parents[name] else [])]

    common = set.intersection(*(set(up(name)) for name in members))
    lowest = next(name for name in up(next(iter(members))) if name in common)
    assert lowest == Tree(parents).lowest_common_dominant(members)
