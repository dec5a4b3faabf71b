"""DM3: commands that the robot was never meant to drive."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from rampart.actors.osmosis.detection.bounds import beyond


@given(st.floats(), st.floats())
def test_active_if_and_only_if_the_command_is_out_of_bounds(linear, angular):
    fault = beyond(linear, angular, 1.0, 2.0)
    outside = not abs(linear) <= 1.0 + 2.1e-6 or not abs(angular) <= 2.0 + 3.1e-6
    inside = abs(linear) <= 1.0 and abs(angular) <= 2.0
    assert fault or not outside
    assert not (fault and inside)
