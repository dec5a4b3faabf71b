"""DM1 looks at the prohibited area only where a bound does not tell enough, and finds the same."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st
from shapely.geometry import box

from rampart.actors.osmosis.airport.model import Airport, StartPose
from rampart.actors.osmosis.detection.area.geofence import (
    DistanceBound,
    FenceLimits,
    intrusion,
    reach_m,
)
from rampart.actors.osmosis.messages import GpsFix

AIRPORT = Airport(
    name="L", nodes={}, edges=(), start=StartPose(0.0, 0.0, 0.0),
    allowed=box(-20, -4, 20, 4).union(box(10, -4, 16, 30)))
LIMITS = FenceLimits(half_diagonal_m=0.473, reaction_s=0.3, braking_mps2=2.0)

PLACES = st.tuples(st.floats(-25, 25), st.floats(-8, 35))
WALKS = st.tuples(PLACES, st.lists(st.tuples(
    st.floats(-3, 3), st.floats(-3, 3), st.floats(-2, 2), st.floats(-2, 2)), max_size=30))


@settings(max_examples=200, deadline=None)
@given(WALKS, st.floats(0, 6))
def test_the_bound_says_what_the_exact_distance_says(walk, needed_m):
    bound = DistanceBound(AIRPORT.prohibited_distance_m)
    (x_m, y_m), steps = walk
    for dx_m, dy_m, _, _ in steps:
        x_m, y_m = x_m + dx_m, y_m + dy_m
        exact_m = AIRPORT.prohibited_distance_m(x_m, y_m)
        assert bound.exceeds(x_m, y_m, needed_m) == (exact_m > needed_m)


@settings(max_examples=200, deadline=None)
@given(WALKS, st.sampled_from([0.0, 0.1]))
def test_a_robot_farther_away_than_its_reach_intrudes_nowhere(walk, extra_m):
    bound = DistanceBound(AIRPORT.prohibited_distance_m)
    (x_m, y_m), steps = walk
    for dx_m, dy_m, vx_mps, vy_mps in steps:
        x_m, y_m = x_m + dx_m, y_m + dy_m
        fix = GpsFix(x_m, y_m, vx_mps, vy_mps, 0.05)
        if bound.exceeds(x_m, y_m, reach_m(fix, LIMITS, extra_m)):
            assert not intrusion(fix, AIRPORT.prohibited_distance_m, LIMITS, extra_m)
