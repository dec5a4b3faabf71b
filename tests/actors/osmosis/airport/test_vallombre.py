"""What the rest of the system relies on in the shipped airport."""

from __future__ import annotations

import heapq
import math
from itertools import pairwise

import pytest
import shapely
from shapely.geometry import LineString

from rampart.actors.osmosis.airport.formats import load_airport
from rampart.actors.osmosis.airport.photometry import (
    SENSOR_HEIGHT_M,
    illuminance_per_candela,
)

AIRPORT = load_airport("vallombre")


def shortest_m(a: str, b: str, without: frozenset[str] = frozenset()) -> float:
    done, todo = {a: 0.0}, [(0.0, a)]
    while todo:
        so_far_m, node = heapq.heappop(todo)
        if node == b:
            return so_far_m
        for other, length_m in AIRPORT.neighbours[node]:
            if frozenset((node, other)) == without:
                continue
            if so_far_m + length_m < done.get(other, math.inf):
                done[other] = so_far_m + length_m
                heapq.heappush(todo, (done[other], other))
    return math.inf


@pytest.mark.parametrize("row", ["A", "B"])
def test_each_row_has_ten_lights_or_more_about_4_m_apart_on_the_graphs_edges(row):
    lights = [light for light in AIRPORT.lights if light.row == row]
    assert len(lights) >= 10
    for one, two in pairwise(lights):
        assert math.dist((one.x_m, one.y_m), (two.x_m, two.y_m)) == pytest.approx(4.0, abs=0.1)
    for light in lights:
        assert AIRPORT.nearest_on_graph(light.x_m, light.y_m).distance_m < 0.05


def test_light_verification_legs_pass_over_every_light_of_the_row():
    goals = AIRPORT.missions["AB"].goals
    legs = [(a, b) for a, b in pairwise(goals)
            if b.mode == "light verification"]  # fmt: skip
    lines = [LineString([(a.x_m, a.y_m), (b.x_m, b.y_m)]) for a, b in legs]
    for light in AIRPORT.lights:
        nearest = min(line.distance(shapely.Point(light.x_m, light.y_m)) for line in lines)
        assert nearest < 0.05


def test_there_is_another_way_whichever_edge_is_closed():
    for a, b in AIRPORT.edges:
        assert shortest_m(a, b, frozenset((a, b))) < math.inf, (a, b)


def test_four_obstacles_can_be_passed_and_the_fifth_blocks_a_runway_for_a_while():
    assert len(AIRPORT.obstacles) >= 5
    for preset in AIRPORT.obstacles[:4]:
        assert AIRPORT.nearest_on_graph(preset.x_m, preset.y_m).distance_m < 0.5
        # A passage as wide as the robot plus 0.3 m on either side remains on one side at least.
        room_m = AIRPORT.prohibited_distance_m(preset.x_m, preset.y_m) - preset.radius_m
        assert room_m > 0.614 + 2 * 0.3
        assert preset.gone_after_s is None
    blocker = AIRPORT.obstacles[4]
    assert blocker.appears_within_m
    assert blocker.gone_after_s


def test_photometry_follows_the_inverse_square_and_the_cosine_law():
    assert illuminance_per_candela(0.0) == pytest.approx(1 / SENSOR_HEIGHT_M**2)
    # As far sideways as high: twice the square of the distance, cosine 1 / sqrt 2.
    expected = 1 / (2 * SENSOR_HEIGHT_M**2) / math.sqrt(2)
    assert illuminance_per_candela(SENSOR_HEIGHT_M) == pytest.approx(expected)
    assert illuminance_per_candela(4.0) < 0.001 * illuminance_per_candela(0.0)
