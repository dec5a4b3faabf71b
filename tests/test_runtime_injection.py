"""The fault gate alone: what each mode does to a message, and when it counts as affected."""

from __future__ import annotations

import pytest

from actors.messages import Goal, Injection, Mode, Odometry, Pose, Route, Twist
from actors.runtime.injection import FaultGate

KEY = "rampart/localization/pose"
POSE = Pose(1.0, 2.0, 0.5)


def gate(mode: str, **fields: object) -> FaultGate:
    found = FaultGate()
    assert found.order(Injection("i", "localization/pose", mode, 5.0, **fields), 10.0) == ""
    return found


def test_a_delay_is_added_and_the_content_kept():
    out = gate("delay", delay_s=0.3).apply(KEY, POSE, 11.0, 11.0)
    assert (out.body, out.stamp, out.delay_s) == (POSE, 11.0, 0.3)


def test_a_ramp_grows_from_the_moment_of_the_order():
    ramp = gate("corrupt", ramp_fields={"y_m": 0.25})
    assert ramp.apply(KEY, POSE, 10.0, 10.0).body == POSE
    assert ramp.apply(KEY, POSE, 14.0, 14.0).body == Pose(1.0, 3.0, 0.5)


def test_a_route_keeps_its_ends_and_a_nested_field_is_reached_by_its_path():
    route = Route("m", 0, Mode.TAXI, True, ((0.0, 0.0), (1.0, 5.0), (9.0, 9.0)), "")
    short = gate("corrupt", keep_ends=("waypoints",)).apply(KEY, route, 10.0, 10.0).body
    assert short.waypoints == ((0.0, 0.0), (9.0, 9.0))
    odometry = Odometry(POSE, Twist(0.5, 0.0))
    moved = gate("corrupt", set_fields={"pose.x_m": 7.0}).apply(KEY, odometry, 10.0, 10.0).body
    assert moved == Odometry(Pose(7.0, 2.0, 0.5), Twist(0.5, 0.0))


@pytest.mark.parametrize(("fields", "words"), [
    ({"set_fields": {"z_m": 1.0}}, "'z_m': no such field"),
    ({"set_fields": {"x_m": "far"}}, "corrupt Pose"),
])
def test_a_corruption_that_does_not_fit_is_refused_and_affects_nothing(fields, words):
    broken = gate("corrupt", **fields)
    with pytest.raises(ValueError, match=words):
        broken.apply(KEY, POSE, 10.0, 10.0)
    assert broken.expire("i") == 0


def test_other_keys_pass_and_an_unknown_mode_is_refused_by_name():
    drop = gate("drop")
    assert drop.apply("rampart/mission/goal", Goal(0.0, 0.0, Mode.TAXI), 10.0, 10.0) is not None
    assert drop.apply(KEY, POSE, 10.0, 10.0) is None
    assert drop.expire("i") == 1
    assert "'hug'" in FaultGate().order(Injection("i", "x", "hug", 1.0), 0.0)
