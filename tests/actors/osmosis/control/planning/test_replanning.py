"""Reactions to a blockage: it is detected, passed, or avoided by another route."""

from __future__ import annotations

import asyncio
import itertools
import math
from itertools import groupby
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
from rampart.actors.osmosis.control.following.light_row import LightRow, RowLimits
from rampart.actors.osmosis.control.following.route_control import BlockageWatch
from rampart.actors.osmosis.control.planning.graph_planner import GraphPlanner
from rampart.actors.osmosis.control.planning.route_search import without
from rampart.actors.osmosis.control.polyline import NO_POINTS
from rampart.actors.osmosis.messages import Mode
from tests.actors.osmosis.control.world import Circle, World, drive
from tests.osmosis_system import System, in_system

AIRPORT = load_airport("vallombre")
RING = {"A": (0.0, 0.0), "B": (20.0, 0.0), "C": (20.0, 20.0), "D": (0.0, 20.0)}
EDGES = [("A", "B"), ("B", "C"), ("C", "D"), ("D", "A")]


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


# ---- light verification -------------------------------------------------------------------------

ROW = ((0.0, 0.0), (30.0, 0.0))


def row(pass_after_s=5.0, half_width_m=2.75):
    return LightRow(ROW, limits=RowLimits(pass_after_s=pass_after_s),
                    edge_m=lambda _x, y: half_width_m - abs(y))


@pytest.mark.parametrize("aside_m", [-0.4, 0.0])
def test_an_obstacle_that_stays_is_passed_after_a_wait_and_the_row_is_taken_up_behind_it(aside_m):
    world = World(circles=[Circle(12.0, aside_m, 0.4)])
    motion = drive(world, row(), 70.0)
    assert motion.arrived
    assert world.least_clearance_m >= 0.2
    assert max(abs(y) for _, y in world.track) <= 1.45
    behind = [abs(y) for x, y in world.track if x > 16.0]
    assert behind
    assert max(behind) <= 0.25, "on the row again soon"


@pytest.mark.parametrize(("follower", "aside_m"), [
    (lambda: LightRow(ROW), (0.0,)), (lambda: row(half_width_m=1.3), (0.0,)),
    (row, (-2.0, -1.0, 0.0, 1.0, 2.0))],
    ids=["as in the paper", "no room on the pavement", "both sides are blocked"])
def test_else_it_waits_and_touches_nothing(follower, aside_m):
    world = World(circles=[Circle(12.0, y_m, 0.4) for y_m in aside_m])
    motion = drive(world, follower(), 30.0)
    assert not motion.arrived
    assert motion.linear_mps == 0.0
    assert world.least_clearance_m >= 0.2
    if len(aside_m) == 1:
        assert max(abs(y) for _, y in world.track) < 0.05


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
