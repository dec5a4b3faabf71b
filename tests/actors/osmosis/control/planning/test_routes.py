"""Routes: found, checked, and planned anew around what blocks the way."""

from __future__ import annotations

import asyncio
import itertools
import math
from itertools import groupby
from random import Random
from typing import Any

import msgspec
import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.airport.formats import load_airport
from rampart.actors.osmosis.airport.model import Airport, StartPose
from rampart.actors.osmosis.airport.route_check import RouteCheck
from rampart.actors.osmosis.control.following.route_control import BlockageWatch
from rampart.actors.osmosis.control.planning.graph_planner import GraphPlanner
from rampart.actors.osmosis.control.planning.route_search import plan_route, without
from rampart.actors.osmosis.control.polyline import NO_POINTS
from rampart.actors.osmosis.messages import Mode
from tests.osmosis_system import System, in_system

RING = {"A": (0.0, 0.0), "B": (20.0, 0.0), "C": (20.0, 20.0), "D": (0.0, 20.0)}
EDGES = [("A", "B"), ("B", "C"), ("C", "D"), ("D", "A")]


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
    plan = plan_route(RING, EDGES, (15.0, 0.8), (20.0, 6.0))
    assert plan.waypoints == ((15.0, 0.0), (20.0, 0.0), (20.0, 6.0))


def test_the_reason_says_what_is_missing():
    far = plan_route(RING, EDGES, (0.0, 0.0), (10.0, 10.0))
    assert far.reason == "goal (10.0, 10.0) is 10.0 m from the graph, expected at most 3.0 m"
    lost = plan_route(RING, EDGES, (60.0, 0.0), (0.0, 0.0))
    assert lost.reason.startswith("start (60.0, 0.0) is 40.0 m from the graph")
    island = plan_route({**RING, "X": (50.0, 0.0), "Y": (60.0, 0.0)}, [*EDGES, ("X", "Y")],
                        (0.0, 0.0), (55.0, 0.0))
    assert island.reason == "no route in the graph from (0.0, 0.0) to (55.0, 0.0)"
    assert plan_route({}, [], (0.0, 0.0), (1.0, 0.0)).reason == "the graph has no open edge"
    assert "finite" in plan_route(RING, EDGES, (math.nan, 0.0), (1.0, 0.0)).reason


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
    assert plan_route(RING, EDGES, (0.0, 0.0), (10.0, 2.0)).waypoints == (
        (0.0, 0.0), (10.0, 0.0), (10.0, 2.0))
    assert plan_route(RING, EDGES, (0.0, 0.0), (10.0, 0.5)).waypoints == ((0.0, 0.0), (10.0, 0.5))


# ---- which routes may be driven ------------------------------------------------------------------

AIRPORT = load_airport("vallombre")
CHECK = RouteCheck(AIRPORT)
PAVED = shapely.box(-3.0, -3.0, 33.0, 3.0).union(shapely.box(27.0, -3.0, 33.0, 30.0))
CORNER = Airport("corner", {"A": (0.0, 0.0), "B": (30.0, 0.0), "C": (30.0, 27.0)},
                 (("A", "B"), ("B", "C")), PAVED, StartPose(0.0, 0.0, 0.0))
ALONG = ((0.0, 0.0), (30.0, 0.0), (30.0, 27.0))


def fault(*waypoints, robot=None, goal=None, airport=CORNER):
    return RouteCheck(airport).fault(waypoints, robot, goal)


def places():
    return st.sampled_from(AIRPORT.edges).flatmap(lambda edge: st.tuples(
        st.just(edge), st.floats(0, 1), st.floats(-1.2, 1.2), st.floats(-1.2, 1.2)))


def at(place):
    (a, b), share, dx, dy = place
    (x0, y0), (x1, y1) = AIRPORT.nodes[a], AIRPORT.nodes[b]
    return x0 + share * (x1 - x0) + dx, y0 + share * (y1 - y0) + dy


@given(places(), places(), st.booleans(), st.lists(places(), max_size=1))
def test_every_route_that_the_planner_finds_also_round_something_is_a_good_one(
        start, goal, straight, blocked):
    robot, target = at(start), at(goal)
    nodes, edges = without(AIRPORT.nodes, AIRPORT.edges, map(at, blocked), 1.0)
    plan = plan_route(nodes, edges, robot, target, straight=straight and not blocked)
    assert plan.waypoints or blocked
    assert not plan.waypoints or CHECK.fault(plan.waypoints, robot, target) == ""


@given(places(), places(), st.integers(0, 10**6))
def test_a_route_that_is_shifted_as_a_whole_is_noticed_by_its_end(start, goal, seed):
    draw = Random(seed)
    shift = [draw.choice((-1, 1)) * draw.uniform(0.5, 3.0) for _ in "xy"]
    plan = plan_route(AIRPORT.nodes, AIRPORT.edges, at(start), at(goal))
    moved = tuple((x + shift[0], y + shift[1]) for x, y in plan.waypoints)
    assert "from the goal" in CHECK.fault(moved, at(start), at(goal))


FAULTS = {
    "all is well": (ALONG, (0.5, 0.4), (30.0, 27.0), ""),
    "only a point": (((5.0, 0.0),), (5.0, 1.0), (5.0, 0.0), ""),
    "nothing": ((), None, None, "no waypoints"),
    "not a number": (((0.0, 0.0), (math.nan, 0.0)), None, None, "not finite"),
    "it ends elsewhere": (ALONG, None, (30.0, 20.0), "ends at (30.0, 27.0), 7.0 m from the goal"),
    "it begins elsewhere": (ALONG, (10.0, 3.5), None, "3.5 m from the route"),
    "the robot is on its way": (ALONG, (30.5, 14.0), (30.0, 27.0), ""),
    "across the grass": (((0.0, 0.0), (30.0, 27.0)), None, None, "leg 1 from (0.0, 0.0) to "
                         "(30.0, 27.0) crosses the prohibited area"),
    "along the edge": (((0.0, 0.0), (27.0, 2.6), (30.0, 27.0)), None, None,
                       "passes 0.40 m from the prohibited area, expected at least 0.60 m"),
    "over pavement where no edge is": (((0.0, 1.9), (26.0, 1.9)), None, None,
                                       "leg 1 from (0.0, 1.9) to (26.0, 1.9) follows no edge"),
    "back to the graph": (((2.0, 2.2), (3.0, 0.0), (30.0, 0.0)), (2.0, 2.2), None, ""),
    "off the graph to the goal": (((0.0, 0.0), (20.0, 0.0), (20.0, 2.2)), None, None, ""),
    "off the graph on the way": (((0.0, 0.0), (9.0, 0.0), (9.0, 2.2), (20.0, 2.2), (20.0, 0.0),
                                  (30.0, 0.0)), None, None, "leg 2"),
    "across the corner": (((27.5, 0.0), (30.0, 2.5), (30.0, 27.0)), None, None,
                          "leaves the graph on the way"),
    "too far along beside it": (((0.0, 0.0), (5.0, 0.0), (25.0, 2.2)), None, None,
                                "leg 2 from (5.0, 0.0) to (25.0, 2.2) ends off the graph"),
}


@pytest.mark.parametrize("case", FAULTS.values(), ids=FAULTS.keys())
def test_a_route_is_refused_with_the_leg_and_the_reason(case):
    waypoints, robot, goal, expected = case
    found = fault(*waypoints, robot=robot, goal=goal)
    assert (found == "") == (expected == "")
    assert expected in found




# ---- closures -----------------------------------------------------------------------------------


def lines(nodes, edges):
    return shapely.MultiLineString([(nodes[a], nodes[b]) for a, b in edges])


@given(st.lists(st.tuples(st.floats(-1, 21), st.floats(-1, 21)), max_size=3),
       st.floats(0.3, 3.0))
def test_what_is_left_of_the_graph_is_what_is_not_near_a_closed_place(places, gap_m):
    nodes, edges = without(RING, EDGES, places, gap_m)
    assert set(RING) <= set(nodes)
    whole, left, closed = lines(RING, EDGES), lines(nodes, edges), shapely.MultiPoint(places)
    assert left.difference(whole.buffer(1e-6)).length < 1e-3, "nothing is added"
    assert left.intersection(closed.buffer(gap_m - 0.01)).length < 1e-3, "closed, so it is gone"
    gone = whole.difference(left.buffer(1e-6))
    assert gone.difference(closed.buffer(gap_m + 0.1)).length < 1e-3, "open, so it is there"


# ---- blockage -----------------------------------------------------------------------------------

BESIDE = np.array([(0.2, 0.9)])
AHEAD = np.array([(1.0, 0.1), (2.0, 0.0), (0.2, 0.9)])
HERE = (10.0, 5.0, math.pi / 2)


def test_no_progress_with_something_ahead_is_a_blockage_since_the_last_progress():
    watch = BlockageWatch()
    for now_s, to_go_m in ((0.0, 20.0), (1.0, 19.0), (2.0, 18.9), (3.0, 18.8), (3.9, 18.8)):
        assert watch.update(to_go_m, HERE, AHEAD, now_s) is None
    found = watch.update(18.8, HERE, AHEAD, 4.0)
    assert (found.x_m, found.y_m) == pytest.approx((9.9, 6.0))
    assert found.since_s == 1.0
    assert watch.update(18.9, (10.0, 5.0, 0.0), NO_POINTS, 9.0) == found, "it stays where it was"
    assert watch.update(18.6, HERE, AHEAD, 10.0) is None, "the robot gets on"
    standing = BlockageWatch()
    for now_s in range(30):
        assert standing.update(20.0, HERE, BESIDE, now_s) is None, "it stands on an empty runway"


# ---- the planner as an actor --------------------------------------------------------------------

ORDER = m.GoalOrder("m1", 0, m.Goal(-22.0, -18.5, Mode.TAXI), True)
CRATE = (-29.3, -5.0)


class Planned:
    """The planner with the robot at the start of a route past the crate."""

    def __init__(self, system: System, **parameters: float) -> None:
        self.system, self.heard = system, system.hear(topics.ROUTE)
        system.start("graph_planner", GraphPlanner, **parameters)

    async def begin(self) -> None:
        await self.system.settle()
        self.system.say(topics.POSE, m.Pose(-29.4, -3.6, -math.pi / 2))
        await self.order()

    async def order(self, **changes: Any) -> None:
        self.system.say(topics.GOAL, msgspec.structs.replace(ORDER, **changes))
        await asyncio.sleep(0.1)

    async def blocked(self, x_m: float, y_m: float, *, step: int = 0, for_s: float = 20.0,
                      mission: str = "m1") -> None:
        since_s = self.system.clock.now() - for_s
        self.system.say(topics.CONTROL_STATUS, m.ControlStatus(
            mission, step, m.ControlPhase.WAITING, 0, 20.0, (m.Blockage(x_m, y_m, since_s),)))
        await asyncio.sleep(0.3)

    @property
    def routes(self) -> list[m.Route]:
        """The routes in sequence, repetitions left out."""
        return [route for route, _ in groupby(heard.message for heard in self.heard)]


def passes(route, place):
    return any(
        math.dist(a, place) + math.dist(place, b) < math.dist(a, b) + 0.2
        for a, b in itertools.pairwise(route.waypoints))


@in_system(airport=AIRPORT)
async def test_the_planner_plans_round_what_has_blocked_the_robot_for_long_enough(system):
    planned = Planned(system, replan_after_s=16.0)
    await planned.begin()
    for wrong in ({"for_s": 15.0}, {"step": 1}, {"mission": "m2"}):
        await planned.blocked(*CRATE, **wrong)
        assert len(planned.routes) == 1
    await planned.blocked(*CRATE, for_s=16.5)
    direct, detour = planned.routes
    assert passes(direct, CRATE)
    assert not passes(detour, CRATE)
    assert detour.waypoints[-1] == direct.waypoints[-1]
    assert detour.reason == "route around (-29.3, -5.0), which is blocked"
    for step in (1, 2):  # avoided for later goals, too, and then tried again
        await asyncio.sleep(31.0)
        await planned.order(step=step)
    _, _, soon, late = planned.routes
    assert not passes(soon, CRATE)
    assert passes(late, CRATE)


@in_system(airport=AIRPORT)
async def test_without_another_way_and_after_a_report_of_no_place_the_route_stays(system):
    planned = Planned(system, replan_after_s=16.0, avoid_gap_m=30.0)
    await planned.begin()
    await planned.blocked(math.nan, CRATE[1])
    await planned.order(step=1, goal=m.Goal(-29.4, -3.3, Mode.TAXI))
    await planned.blocked(-29.4, -3.3, step=1)
    assert [route.step for route in planned.routes] == [0, 1]


@in_system(airport=AIRPORT)
async def test_another_plan_that_is_asked_for_avoids_what_is_in_the_way(system):
    planned = Planned(system)
    await planned.begin()
    await planned.blocked(*CRATE, for_s=4.0)
    await planned.order(plan=1)
    direct, detour = planned.routes
    assert passes(direct, CRATE)
    assert not passes(detour, CRATE)
    assert (direct.plan, detour.plan) == (0, 1)
