"""The effect of a joystick, as shown on the page."""

from __future__ import annotations

import pytest

from rampart.actors.osmosis.page.hmi import effect


@pytest.mark.parametrize(("known", "works", "text"), [
    ({}, True, "overrides the mission"),
    ({"mode": "teleoperation"}, True, "obeys only the joystick"),
    ({"forbids": "RM2: it is stale", "mode": "stop"}, False, "no effect: RM2: it is stale"),
    ({"brake": True}, False, "the brake is engaged"),
    ({"pilot_heard": False}, False, "the Safety Pilot is silent"),
    ({"dead_nodes": ("teleoperation",), "brake": True}, False, "teleoperation does not run"),
])
def test_the_page_says_whether_the_stick_has_an_effect_and_why_not(known, works, text):
    heard = {"pilot_heard": True, "mode": "auto", "forbids": "", "brake": False, "dead_nodes": ()}
    got, words = effect(**heard | known)
    assert got is works
    assert text in words
