"""Orders and trees: the paper's examples, and Warshall's closure as an oracle."""

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rampart.manager.model.fault_tree import Event, FaultTree, FaultTreeError
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


# -- fault trees: gates, what is no tree, and the FTMTree read off it


def tree(**gates: tuple[int, str]) -> FaultTree:
    """`top=(1, "a b")` is top = OR(a, b); names that are only mentioned are basic events."""
    events = {name: Event(name, tuple(inputs.split()), required)
              for name, (required, inputs) in gates.items()}
    for event in list(events.values()):
        for name in event.inputs:
            events.setdefault(name, Event(name))
    return FaultTree(list(events.values()))


def test_an_event_propagates_through_several_gates():
    events = tree(top=(1, "x y"), x=(2, "a b c"), y=(3, "c d e"))
    assert events.occurring(["a", "c"]) == {"a", "c", "x", "top"}
    assert events.occurring(["a"]) == {"a"}
    assert events.occurring(["d", "e"]) == {"d", "e"}
    assert "y" in events.occurring(["c", "d", "e"])
    assert events.top == "top"


def test_the_parent_of_a_mechanism_is_the_nearest_one_above_however_far():
    events = tree(top=(1, "x y"), x=(1, "p"), p=(1, "q"), q=(1, "a"))
    ftms = events.derive_ftm_tree({"F1": "top", "F2": "p", "F3": "a", "F4": "y"})
    assert ftms.parents == {"F1": None, "F2": "F1", "F3": "F2", "F4": "F1"}


def test_a_shared_event_is_fine_while_its_mechanism_has_one_parent():
    events = tree(top=(1, "x y"), x=(1, "a"), y=(1, "a b"))
    assert events.derive_ftm_tree({"F1": "top", "F2": "a"}).parents["F2"] == "F1"


@pytest.mark.parametrize(("placement", "subject", "message"), [
    ({"F1": "top", "F2": "x", "F3": "y", "F4": "a"}, "F4", "several parents .*: F2, F3"),
    ({"F1": "top", "F2": "x", "F4": "a"}, "F4", "several parents .*: F1, F2"),
    ({"F2": "x", "F4": "a"}, "F4", "several parents .*: F2, none"),
    ({"F2": "x", "F3": "y"}, "F3", "2 roots: F2, F3"),
    ({}, "", "0 roots: none"),
    ({"F1": "top", "F2": "top"}, "F2", "event 'top' already has F1"),
])
def test_a_placement_that_makes_no_tree_is_refused(placement, subject, message):
    events = tree(top=(1, "x y"), x=(1, "a"), y=(1, "a b"))
    with pytest.raises(FaultTreeError, match=message) as caught:
        events.derive_ftm_tree(placement)
    assert subject == caught.value.subject


@pytest.mark.parametrize(("events", "message"), [
    ([Event("a", (), 1)], "gate without inputs"),
    ([Event("a", ("b",), 2), Event("b")], "gate needs 2 of 1 inputs"),
    ([Event("a", ("b",), 0), Event("b")], "gate needs 0 of 1 inputs"),
    ([Event("a", ("b", "b"), 1), Event("b")], "'b' is listed twice"),
    ([Event("t", ("a",), 1), Event("a", ("b",), 1), Event("b", ("a",), 1)], "cycle a > b > a"),
    ([Event("a"), Event("b")], "unreachable from the top event 'a'"),
    ([], "no events"),
])
def test_what_is_no_fault_tree_is_refused(events, message):
    with pytest.raises(FaultTreeError, match=message):
        FaultTree(events)
