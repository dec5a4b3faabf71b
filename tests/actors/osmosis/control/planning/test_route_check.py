"""Which routes may be driven: the planner's own may, and what a fault makes of them may not."""

import math
from random import Random

import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from rampart.actors.osmosis.airport.formats import load_airport
from rampart.actors.osmosis.airport.model import Airport, StartPose
from rampart.actors.osmosis.airport.route_check import RouteCheck
from rampart.actors.osmosis.control.planning.route_search import plan_route, without

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
