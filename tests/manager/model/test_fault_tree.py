"""Fault trees: gates, what is no tree, and the FTMTree read off it."""

import pytest

from rampart.manager.model.fault_tree import Event, FaultTree, FaultTreeError


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
