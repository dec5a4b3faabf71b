import itertools
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rampart.actors.osmosis.control.planning.route_search import plan_route

SQUARE = {"A": (0.0, 0.0), "B": (20.0, 0.0), "C": (20.0, 20.0), "D": (0.0, 20.0)}
RING = [("A", "B"), ("B", "C"), ("C", "D"), ("D", "A")]


def shortest_by_trying_everything(nodes, edges, start, goal):
    """Length of the shortest simple path between two nodes, over all of them."""
    linked = {frozenset(edge) for edge in edges}
    between = [name for name in nodes if name not in (start, goal)]
    best = math.inf
    for count in range(len(between) + 1):
        for middle in itertools.permutations(between, count):
            path = (start, *middle, goal)
            if all(frozenset(pair) in linked for pair in itertools.pairwise(path)):
                best = min(best, sum(math.dist(nodes[a], nodes[b])
                                     for a, b in itertools.pairwise(path)))
    return best


@st.composite
def graphs(draw):
    # A coarse grid keeps nodes apart, so that start and goal snap to the nodes meant.
    cells = draw(st.lists(st.tuples(st.integers(0, 6), st.integers(0, 6)),
                          min_size=3, max_size=6, unique=True))
    nodes = {f"N{i}": (10.0 * x, 10.0 * y) for i, (x, y) in enumerate(cells)}
    pairs = list(itertools.combinations(nodes, 2))
    edges = draw(st.lists(st.sampled_from(pairs), min_size=1, unique=True))
    return nodes, edges


@given(graphs())
def test_a_route_is_as_short_as_the_best_of_all_paths(graph):
    nodes, edges = graph
    names = sorted({name for edge in edges for name in edge})
    start, goal = names[0], names[-1]
    expected_m = shortest_by_trying_everything(nodes, edges, start, goal)
    plan = plan_route(nodes, edges, nodes[start], nodes[goal])
    if math.isinf(expected_m):
        assert plan.waypoints == ()
        assert "no route" in plan.reason
    else:
        assert plan.reason == ""
        length_m = sum(math.dist(a, b) for a, b in itertools.pairwise(plan.waypoints))
        assert math.isclose(length_m, expected_m, rel_tol=1e-9)


def test_start_and_goal_between_nodes_join_at_their_edges():
    plan = plan_route(SQUARE, RING, (15.0, 0.8), (20.0, 6.0))
    assert plan.waypoints == ((15.0, 0.0), (20.0, 0.0), (20.0, 6.0))


def test_the_reason_says_what_is_missing():
    far = plan_route(SQUARE, RING, (0.0, 0.0), (10.0, 10.0))
    assert far.reason == "goal (10.0, 10.0) is 10.0 m from the graph, expected at most 3.0 m"
    lost = plan_route(SQUARE, RING, (60.0, 0.0), (0.0, 0.0))
    assert lost.reason.startswith("start (60.0, 0.0) is 40.0 m from the graph")
    island = plan_route({**SQUARE, "X": (50.0, 0.0), "Y": (60.0, 0.0)}, [*RING, ("X", "Y")],
                        (0.0, 0.0), (55.0, 0.0))
    assert island.reason == "no route in the graph from (0.0, 0.0) to (55.0, 0.0)"
    assert plan_route({}, [], (0.0, 0.0), (1.0, 0.0)).reason == "the graph has no open edge"
    assert "finite" in plan_route(SQUARE, RING, (math.nan, 0.0), (1.0, 0.0)).reason


def test_a_straight_row_loses_its_inner_nodes_and_a_bent_one_keeps_them():
    row = {"A": (0.0, 0.0), "M": (10.0, 0.3), "B": (20.0, 0.0)}
    edges = [("A", "M"), ("M", "B")]
    assert plan_route(row, edges, row["A"], row["B"], straight=True).waypoints == (
        (0.0, 0.0), (20.0, 0.0))
    assert len(plan_route(row, edges, row["A"], row["B"]).waypoints) == 3
    bent = {**row, "M": (10.0, 4.0)}
    assert len(plan_route(bent, edges, bent["A"], bent["B"], straight=True).waypoints) == 3


@pytest.mark.parametrize(("start", "begins"), [
    ((-0.4, 0.4), (0.0, 0.0)),  # has come from C, not quite at A: the row is A to B
    ((-3.0, 3.0), (-3.0, 3.0)),  # still on the way to it
    ((6.0, 0.1), (6.0, 0.0)),  # in the middle of the row, as after a respawn
])
def test_a_row_begins_at_its_node_and_not_beside_it(start, begins):
    row = {"C": (-5.0, 5.0), "A": (0.0, 0.0), "B": (20.0, 0.0)}
    found = plan_route(row, [("C", "A"), ("A", "B")], start, row["B"], straight=True)
    assert found.waypoints[0] == pytest.approx(begins)
    assert found.waypoints[-1] == row["B"]


def test_a_goal_well_off_the_line_is_turned_to_where_it_is_nearest():
    assert plan_route(SQUARE, RING, (0.0, 0.0), (10.0, 2.0)).waypoints == (
        (0.0, 0.0), (10.0, 0.0), (10.0, 2.0))
    assert plan_route(SQUARE, RING, (0.0, 0.0), (10.0, 0.5)).waypoints == ((0.0, 0.0), (10.0, 0.5))
