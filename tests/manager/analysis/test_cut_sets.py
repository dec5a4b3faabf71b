"""Minimal cut sets against brute force, and against counts that are known."""

import subprocess
import sys
from itertools import combinations
from math import comb

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rampart.manager.analysis import cut_sets
from rampart.manager.analysis.cut_sets import CutSets, TooLargeError
from rampart.manager.analysis.formula import Connective, Formula, FormulaError


def formula(gates: dict[str, Connective], house: dict[str, bool] | None = None, top: str = ""
            ) -> Formula:
    """A formula; names that are no gates and no house events are basic events."""
    used = {entry for gate in gates.values() for entry in gate.inputs}
    return Formula(gates, frozenset(used - gates.keys() - (house or {}).keys()), house or {}, top)


def any_of(*inputs: str) -> Connective:
    return Connective(inputs, 1, len(inputs))


def all_of(*inputs: str) -> Connective:
    return Connective(inputs, len(inputs), len(inputs))


def occurs(tree: Formula, occurred: frozenset[str]) -> bool:
    """Whether the top occurs when exactly these basic events do."""
    value = {name: name in occurred for name in tree.basic} | tree.house
    for name in tree.sequence:
        gate = tree.gates[name]
        count = sum(value[entry] for entry in gate.inputs)
        value[name] = (gate.low <= count <= gate.high) != gate.negated
    return value[tree.top]


def brute_force(tree: Formula) -> set[frozenset[str]]:
    """All sets for which the top occurs and for no part of which it does."""
    found: list[frozenset[str]] = []
    for size in range(len(tree.basic) + 1):
        for chosen in map(frozenset, combinations(tree.basic, size)):
            if occurs(tree, chosen) and not any(smaller < chosen for smaller in found):
                found.append(chosen)
    return set(found)


@st.composite
def trees(draw, *, coherent: bool) -> Formula:
    """Random gates over few events: shared, nested, k-of-n, house events; negations if wanted."""
    names = [f"e{i}" for i in range(draw(st.integers(2, 6)))]
    house = draw(st.dictionaries(st.sampled_from(["h0", "h1"]), st.booleans()))
    usable = [*names, *house]
    gates: dict[str, Connective] = {}
    for i in range(draw(st.integers(1, 8))):
        inputs = draw(st.lists(st.sampled_from(usable), min_size=1, max_size=4, unique=True))
        low = draw(st.integers(0 if not coherent else 1, len(inputs)))
        high = len(inputs) if coherent else draw(st.integers(low, len(inputs)))
        gates[f"g{i}"] = Connective(tuple(inputs), low, high,
                                    negated=not coherent and draw(st.booleans()))
        usable.append(f"g{i}")
    return Formula(gates, frozenset(names), house, f"g{len(gates) - 1}")


@pytest.mark.parametrize("coherent", [True, False])
@given(st.data(), st.integers(0, 4))
def test_trees_have_the_minimal_sets_of_so_many_events_that_brute_force_finds(
        coherent, data, order):
    tree = data.draw(trees(coherent=coherent))
    expected = brute_force(tree)
    for most in (order, None):
        found = CutSets(tree, max_order=most)
        listed = [frozenset(s) for s in found.sets()]
        assert set(listed) == {s for s in expected if most is None or len(s) <= most}
        assert len(listed) == len(set(listed)) == found.count
        assert [len(s) for s in listed] == sorted(len(s) for s in listed)
        for size, count in enumerate(found.sizes):
            assert count == sum(len(s) == size for s in listed)


def ladder(n: int) -> Formula:
    """Each rung shares an event with the next: no module inside, a Fibonacci-like count."""
    rungs = {f"r{i}": any_of(f"e{i}", f"e{i + 1}") for i in range(n)}
    return formula({**rungs, "top": all_of(*rungs)})


def test_hundreds_of_shared_events_and_millions_of_sets_are_counted_not_listed():
    found = CutSets(ladder(400))
    assert found.count > 10 ** 20
    assert sum(found.sizes) == found.count
    assert len(list(found.sets(limit=5))) == 5
    assert [CutSets(ladder(n)).count for n in (1, 2, 5, 9)] == [2, 2, 5, 16]  # vertex covers


def test_more_gates_in_a_chain_than_python_recurses_through_are_no_problem():
    gates = {f"g{i}": any_of(f"g{i + 1}", f"e{i}") if i % 2 else all_of(f"g{i + 1}", f"e{i}")
             for i in range(1200)}
    gates["g1200"] = any_of("last")
    found = CutSets(formula(gates))
    assert found.count == 601
    with pytest.raises(TooLargeError, match="levels deep: expected at most"):
        list(found.sets())


def test_a_tree_of_more_variables_than_the_library_can_recurse_through_is_refused():
    """The process ended with a segmentation fault."""
    with pytest.raises(TooLargeError, match="expected at most 20000"):
        CutSets(formula({"top": all_of(*(f"e{i}" for i in range(30_000)))}))


def test_the_diagrams_of_many_modules_share_their_threads_and_little_address_space():
    """Each had two threads and reserved 1 GB: 25 events aborted within 4 GB."""
    program = (
        "import resource; resource.setrlimit(resource.RLIMIT_AS, (2_000_000_000,) * 2)\n"
        "from rampart.manager.analysis.cut_sets import CutSets\n"
        "from rampart.manager.analysis.formula import Connective, Formula\n"
        "gates = {f'g{i}': Connective((f'a{i}', f'b{i}'), 1, 2) for i in range(100)}\n"
        "gates['top'] = Connective(tuple(gates), 2, 100)\n"
        "events = frozenset(f'{x}{i}' for x in 'ab' for i in range(100))\n"
        "print(CutSets(Formula(gates, events, {})).count)\n")
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True,
                          timeout=60, check=False)
    assert (done.returncode, done.stdout) == (0, f"{comb(100, 2) * 4}\n"), done.stderr


def test_a_tree_beyond_every_bound_is_refused_in_one_line(monkeypatch):
    """Rows and columns of a grid: no order of the variables keeps that small."""
    monkeypatch.setattr(cut_sets, "BOUNDS", (20, 50))
    n = 6
    gates = {f"row{i}": all_of(*(f"x{i}_{j}" for j in range(n))) for i in range(n)}
    gates |= {f"col{j}": any_of(*(f"x{i}_{j}" for i in range(n))) for j in range(n)}
    tree = formula({**gates, "rows": any_of(*(f"row{i}" for i in range(n))),
                    "cols": all_of(*(f"col{j}" for j in range(n))), "top": all_of("rows", "cols")})
    with pytest.raises(TooLargeError, match=r"gate '.*' with 36 inputs and modules: more than 50"):
        CutSets(tree)


@pytest.mark.parametrize(("gates", "words"), [
    ({}, "no gates; expected a top gate"),
    ({"a": any_of("b"), "b": any_of("a")}, "cycle a > b > a"),
    ({"top": any_of("a"), "a": any_of("b"), "b": any_of("a")}, "cycle a > b > a"),
    ({"x": any_of("e"), "y": any_of("e")}, "2 gates are not an input of another gate: x, y"),
])
def test_a_formula_without_a_single_top_or_with_a_cycle_is_refused(gates, words):
    with pytest.raises(FormulaError, match=words):
        formula(gates)
    with pytest.raises(FormulaError, match="gate 'top' has the unknown input 'x'"):
        Formula({"top": any_of("x")}, frozenset(), {})
