"""The shipped airport as the rest of the system relies on it, and the photometry of its lights."""

import math
from itertools import pairwise

import pytest
import shapely

from rampart.actors.osmosis.airport.formats import load_airport
from rampart.actors.osmosis.airport.photometry import SENSOR_HEIGHT_M, illuminance_per_candela
from rampart.actors.osmosis.control.planning.route_search import plan_route

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
