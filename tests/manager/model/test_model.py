"""Orders, trees and gates: closures and truth tables as oracles, and what is refused."""

from itertools import combinations, pairwise

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from rampart.manager.analysis.barriers import guard
from rampart.manager.model.fault_tree import Event, FaultTree, FaultTreeError
from rampart.manager.model.gates import (
    MAX_NAMES,
    MAX_TOKENS,
    Gate,
    GateError,
    detection_gate,
    recovery_gate,
)
from rampart.manager.model.order import CycleError, PartialOrder, UnknownElementError, find_cycle
from tests.manager.bench import closure, paper

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
def test_any_order_agrees_with_its_closure(relation, members):
    letters, places = relation
    pairs = [(letters[i], letters[j]) for i, j in places]
    reach = closure(set(pairs))
    order = PartialOrder(NAMES, {a: [c for b, c in pairs if a == b] for a in NAMES})
    assert {(a, b) for a in NAMES for b in NAMES if order.is_above(a, b)} == reach
    greatest = [a for a in members if all(a == b or (a, b) in reach for b in members)]
    assert (greatest[0] if greatest else None) == order.greatest(members)
    assert {a for a in members if not any((b, a) in reach for b in members)} == set(
        order.maximal(members))


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


# -- which mechanisms stand between causes and the top event


def test_on_the_paper_s_tree_each_cause_has_the_barriers_above_it():
    found = {g.events: g.barriers for g in guard(paper(), [
        ("control_node_crash",), ("localization_node_crash",), ("command_calculation_error",),
        ("actuator_failure",), ("control_node_crash", "command_calculation_error")])}
    assert found == {
        ("control_node_crash",): ("FTM1", "FTM2", "FTM4"),
        ("localization_node_crash",): ("FTM1", "FTM6", "FTM7"),
        ("command_calculation_error",): ("FTM1", "FTM3"),
        ("actuator_failure",): ("FTM1",),
        # by two ways, each with a barrier of its own
        ("control_node_crash", "command_calculation_error"): ("FTM1",)}


def test_an_event_that_is_kept_from_occurring_does_not_spread():
    events = tree(top=(2, "a g"), g=(2, "b c d"))
    assert "top" in events.occurring(["a", "b", "c"])
    assert "top" not in events.occurring(["a", "b", "c"], "g")
    assert "top" not in events.occurring(["a", "b", "c"], "b")
    assert "top" in events.occurring(["a", "b", "c", "d"], "b")


# -- gates: truth tables, precedence, negation, silence, and every refusal word for word


MODULES = ("A", "B", "C", "D")


@pytest.mark.parametrize(("text", "same"), [
    ("A or B and C", "A or (B and C)"), ("A and B or C and D", "(A and B) or (C and D)"),
    ("A and not B or C", "(A and (not B)) or C"), ("A and not not B", "A and B"),
    ("A   and\tB\n", "A and B"),
    # a negation goes down to the names
    ("D and not (A or B)", "D and (not A and not B)"),
    ("D and not 2 of (A, B, C)", "D and 2 of (not A, not B, not C)"),
    ("D and not (A and (B or not C))", "D and (not A or (not B and C))"),
])
def test_not_binds_tighter_than_and_which_binds_tighter_than_or(text, same):
    assert detection_gate(text) == detection_gate(same)


LEAVES = st.builds(Gate, name=st.sampled_from(MODULES), negated=st.booleans())


def _over(inputs: st.SearchStrategy[Gate]) -> st.SearchStrategy[Gate]:
    return st.lists(inputs, min_size=2, max_size=4).flatmap(lambda of: st.builds(
        Gate, required=st.integers(1, len(of)), inputs=st.just(tuple(of))))


GATES = st.recursive(LEAVES, _over, max_leaves=10)
PLAIN = st.recursive(
    st.builds(Gate, name=st.sampled_from(MODULES)),
    lambda of: st.lists(of, min_size=2, max_size=3).flatmap(lambda i: st.builds(
        Gate, required=st.sampled_from((1, len(i))), inputs=st.just(tuple(i)))), max_leaves=6)


def by_words(gate: Gate, active: set[str], silent: set[str]) -> bool:
    """The docstring, read aloud: a silent name is good for `A` and for `not A`."""
    if gate.name:
        if gate.name in silent:
            return True
        return (gate.name in active) != gate.negated
    return len([1 for i in gate.inputs if by_words(i, active, silent)]) >= gate.required


@given(GATES, st.sets(st.sampled_from(MODULES)), st.sets(st.sampled_from(MODULES)))
def test_any_gate_holds_as_its_words_say(gate, active, mute):
    silent = mute & active  # a silent module counts as active
    assert gate.holds(active, silent) == by_words(gate, active, silent)


@given(GATES)
@example(Gate(required=2, inputs=(detection_gate("A or B"), detection_gate("C"))))
def test_what_is_written_is_read_again_unless_it_is_active_on_nothing_or_never(gate):
    sets = [active for size in range(5) for active in combinations(MODULES, size)]
    table = [gate.holds(active) for active in sets]
    if table[0] or not any(table):
        with pytest.raises(GateError, match="active"):
            detection_gate(str(gate))
    else:
        again = detection_gate(str(gate))
        assert [again.holds(active) for active in sets] == table
        assert str(again) == str(gate)


@given(PLAIN)
def test_each_alternative_satisfies_its_gate_and_what_satisfies_it_contains_one(gate):
    ways = list(gate.alternatives())
    assert all(gate.holds(way) for way in ways)
    assert all(len(set(way)) == len(way) for way in ways)
    for size in range(len(MODULES) + 1):
        for chosen in combinations(MODULES, size):
            assert gate.holds(chosen) == any(set(way) <= set(chosen) for way in ways)


@pytest.mark.parametrize(("text", "ways"), [
    ("RM4 or RM3 and RM2", [("RM4",), ("RM3", "RM2")]),
    ("(A or B) and (C or D)", [("A", "C"), ("A", "D"), ("B", "C"), ("B", "D")]),
    ("RM2 and (RM2 or RM3)", [("RM2",), ("RM2", "RM3")]),
    ("1 of (A, B)", [("A",), ("B",)]),
    ("2 of (A, B)", [("A", "B")]),
])
def test_alternatives_come_in_the_sequence_of_preference(text, ways):
    assert list(recovery_gate(text).alternatives()) == ways


def many(count: int) -> str:
    return " or ".join(f"X{i}" for i in range(count))


UNREADABLE = (
    "", "A and", "and A", "A or or B", "not", "()", "(A", "A B", "A)", "(A, B)", "A & B",
    "A and \u00e9", "_A", "2", "2 (A, B)", "2 of A", "2 of (A, B", "A # B", "A(B)", "2A",
    "(" * 300)
REFUSED = [
    *((text, "expected names, 'and', 'or'") for text in UNREADABLE),
    ("0 of (A, B)", "0 of 2 inputs; expected 1 to 2"),
    ("2 of ()", "2 of 0 inputs; expected 1 to 0"),
    ("3 of (A, B)", "3 of 2 inputs; expected 1 to 2"),
    ("9" * 5000 + " of (A)", "999999999 of 1 inputs; expected 1 to 1"),
    *((text * MAX_TOKENS, f"{count} names, words and parentheses; expected at most {MAX_TOKENS}")
      for text, count in (("not A ", 2 * MAX_TOKENS), ("1 of (", 3 * MAX_TOKENS))),
    ("(" * 100_000, "100000 names, words and parentheses; expected at most"),
]


@pytest.mark.parametrize("read", [detection_gate, recovery_gate])
@pytest.mark.parametrize(("text", "line"), REFUSED, ids=lambda t: str(t)[:20])
def test_what_cannot_be_read_is_refused_in_one_line(read, text, line):
    with pytest.raises(GateError) as caught:
        read(text)
    assert str(caught.value).startswith(line)


@pytest.mark.parametrize(("read", "text", "words"), [
    (detection_gate, "not A", "active while all its detection modules are idle"),
    (detection_gate, "A or not A", "active while all its detection modules are idle"),
    (detection_gate, "A and B and not (A or C)", "can never be active"),
    (detection_gate, many(MAX_NAMES + 1), f"{MAX_NAMES + 1} detection modules; expected at most"),
    (recovery_gate, "RM2 or (RM3 and not RM1)", "'not RM1' cannot be run"),
    (recovery_gate, "RM4 or 2 of (RM1, RM2, RM3)", "'2 of' is ambiguous"),
    (recovery_gate, many(MAX_NAMES + 1), f"{MAX_NAMES + 1} recovery modules; expected at most")])
def test_a_detection_gate_has_to_change_and_a_recovery_gate_to_say_what_to_run(read, text, words):
    with pytest.raises(GateError, match=words):
        read(text)
    assert detection_gate("None or lambda or None").names == ("None", "lambda")
    assert len(detection_gate(many(MAX_NAMES)).names) == MAX_NAMES
    assert len(recovery_gate(many(MAX_NAMES)).names) == MAX_NAMES
    nested = MAX_TOKENS // 4 - 1
    for deep in ("not " * (MAX_TOKENS - 2) + "A", "1 of (" * nested + "A" + ")" * nested):
        assert detection_gate(deep).holds("A")
        assert detection_gate(deep).names == ("A",)


@pytest.mark.parametrize(("pairs", "ways"), [(7, "128"), (60, str(2**60))])
def test_a_recovery_gate_with_too_many_alternatives_is_refused_without_making_them(pairs, ways):
    with pytest.raises(GateError) as caught:
        recovery_gate(" and ".join(["(RM1 or RM2)"] * pairs))
    assert str(caught.value).startswith(f"{ways} alternatives; expected at most 64")
    assert len(list(recovery_gate(" and ".join(["(RM1 or RM2)"] * 6)).alternatives())) == 64
