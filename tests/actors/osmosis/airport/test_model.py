"""Airport geometry, the checks of an airport, and the shipped one as the rest relies on it."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from rampart.actors.osmosis.airport import model
from rampart.actors.osmosis.airport.formats import load_airport, mission_problems, problems
from rampart.actors.osmosis.airport.photometry import SENSOR_HEIGHT_M, illuminance_per_candela
from rampart.actors.osmosis.control.planning.route_search import plan_route

# A square ring of pavement: outer 20 m, with a prohibited island of 8 m in the middle.
RING = shapely.box(0, 0, 20, 20).difference(shapely.box(6, 6, 14, 14))
NODES = {"SW": (3.0, 3.0), "SE": (17.0, 3.0), "NE": (17.0, 17.0), "NW": (3.0, 17.0)}
EDGES = (("SW", "SE"), ("SE", "NE"), ("NE", "NW"))


def airport(**changes) -> model.Airport:
    made = model.Airport("Ring", NODES, EDGES, RING, model.StartPose(3, 3, 0))
    return replace(made, **changes)


def findings(made: model.Airport) -> list[str]:
    return [f"{found.field}: {found.remedy}" for found in problems(made)]


@given(st.floats(-30, 50), st.floats(-30, 50))
def test_distance_to_the_prohibited_area_agrees_with_geos(x, y):
    point = shapely.Point(x, y)
    expected = RING.boundary.distance(point) * (1 if RING.contains(point) else -1)
    assert airport().prohibited_distance_m(x, y) == pytest.approx(expected, abs=1e-9)


def test_a_footprint_is_in_the_prohibited_area_as_soon_as_one_corner_is():
    made = airport()
    assert not made.footprint_in_prohibited(model.rectangle(0.5, 10, 0, 0.72, 0.614))
    assert made.footprint_in_prohibited(model.rectangle(0.35, 10, 0, 0.72, 0.614))
    # The centre is 0.45 m from the edge: straight it fits, turned its corner is over.
    assert not made.footprint_in_prohibited(model.rectangle(0.45, 10, math.pi / 2, 0.72, 0.614))
    assert made.footprint_in_prohibited(model.rectangle(0.45, 10, 0.7, 0.72, 0.614))


@pytest.mark.parametrize(("changes", "expected"), [
    ({"nodes": {}, "edges": ()}, "nodes: a graph needs at least one node"),
    ({"edges": (("SW", "XX"),)}, "edges[0]: unknown node"),
    ({"edges": (("SW", "SW"),)}, "edges[0]: expected two different nodes"),
    ({"edges": (*EDGES, ("SE", "SW"))}, "edges: duplicate edge"),
    ({"nodes": {**NODES, "NW": (10.0, 10.0)}}, "nodes.NW: in the prohibited area"),
    ({"edges": (*EDGES, ("SW", "NE"))}, "edges[3]: passes through the prohibited area"),
    ({"nodes": {**NODES, "SE": (17.0, 0.2), "SW": (3.0, 0.2)}, "start": model.StartPose(3, 2, 0)},
     "edges[0]: too near to the prohibited area"),
    ({"start": model.StartPose(10, 10, 0)}, "start: in the prohibited area"),
    ({"start": model.StartPose(3, 10, 0), "nodes": {"NE": (17.0, 17.0)}, "edges": ()},
     "start: 15.7 m from the graph"),
    ({"lights": (model.Light("L1", "L", 10, 10, 200),)}, "row.L1: off the pavement"),
    ({"lights": (model.Light("L1", "L", 3, 3, 1),) * 2}, "row: duplicate name of a light"),
    ({"obstacles": (model.ObstaclePreset("o", "box", 9, 3, 0.3),) * 2}, "obstacle: duplicate name"),
    ({"obstacles": (model.ObstaclePreset("o", "box", 3.2, 3, 0.3),)}, "obstacle.o: on the start"),
    ({"allowed": shapely.Polygon()}, "surface: the airport needs pavement"),
])
def test_each_fault_of_an_airport_is_found_and_named(changes, expected):
    assert findings(airport()) == []
    assert any(line.startswith(expected) for line in findings(airport(**changes)))


SPLIT = (("SW", "SE"), ("NE", "NW"))


@pytest.mark.parametrize(("goals", "edges", "expected"), [
    ((), EDGES, "missions.M: a mission needs at least one goal"),
    (((3, 25),), EDGES, "missions.M.goals[0]: 8.0 m from the graph"),
    (((7, 5), (6.4, 6.0)), EDGES, "missions.M.goals[1]: in the prohibited area"),
    (((17, 3), (17, 17)), SPLIT, "missions.M.goals[1]: not connected")])
def test_each_fault_of_a_mission_is_found_and_named(goals, edges, expected):
    mission = model.Mission("M", tuple(model.MissionGoal(x_m, y_m, "taxi") for x_m, y_m in goals))
    found = [f"{p.field}: {p.remedy}" for p in mission_problems(mission, airport(edges=edges))]
    assert any(line.startswith(expected) for line in found)


# ---- the shipped airport, and the photometry of its lights ---------------------------------------

AIRPORT = load_airport("vallombre")


def test_light_verification_legs_pass_over_every_light():
    legs = [shapely.LineString([(a.x_m, a.y_m), (b.x_m, b.y_m)])
            for a, b in pairwise(AIRPORT.missions["AB"].goals) if b.mode == "light verification"]
    assert len(AIRPORT.lights) >= 20
    for light in AIRPORT.lights:
        assert min(leg.distance(shapely.Point(light.x_m, light.y_m)) for leg in legs) < 0.05


def test_there_is_another_way_whichever_edge_is_closed():
    for edge in AIRPORT.edges:
        left = [other for other in AIRPORT.edges if other != edge]
        a, b = (AIRPORT.nodes[name] for name in edge)
        assert plan_route(AIRPORT.nodes, left, a, b).waypoints, edge


def test_photometry_follows_the_inverse_square_and_the_cosine_law():
    assert illuminance_per_candela(0.0) == pytest.approx(1 / SENSOR_HEIGHT_M**2)
    # As far sideways as high: twice the square of the distance, cosine 1 / sqrt 2.
    expected = 1 / (2 * SENSOR_HEIGHT_M**2) / math.sqrt(2)
    assert illuminance_per_candela(SENSOR_HEIGHT_M) == pytest.approx(expected)
    assert illuminance_per_candela(4.0) < 0.001 * illuminance_per_candela(0.0)
