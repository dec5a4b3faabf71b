"""The time budget: formulas against a simulated drive, derivation, what does not fit."""

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rampart.manager.spec.budget import check, find_false_alarms
from rampart.manager.spec.mobile_robot import (
    derive_timeouts,
    time_to_drift_s,
    time_to_intrusion_s,
    time_to_obstacle_s,
    time_to_runaway_s,
)
from rampart.manager.spec.tables import Timing
from tests.manager.bench import paper

SPEC = paper()
ROBOT = SPEC.robot


def changed(table, **values):
    return msgspec.structs.replace(table, **values)


def with_timing(**values):
    return changed(SPEC, timing=changed(SPEC.timing, **values))


def drive_m(robot, waiting_s: float, acceleration_mps2: float) -> float:
    """Distance driven until standstill, step by step: wait with the error, then brake."""
    step_s, distance_m, speed_mps, time_s = 1e-4, 0.0, robot.top_speed_mps, 0.0
    fastest = max(robot.top_speed_mps, robot.hardware_speed_mps)
    while speed_mps > 0:
        rate = acceleration_mps2 if time_s < waiting_s else -robot.braking_mps2
        after = min(max(speed_mps + rate * step_s, 0.0), fastest)
        distance_m += (speed_mps + after) / 2 * step_s
        speed_mps, time_s = after, time_s + step_s
    return distance_m


@settings(max_examples=10, deadline=None)
@given(st.floats(0.3, 2.0), st.floats(0.5, 4.0), st.floats(0.5, 4.0), st.floats(3.0, 12.0))
def test_who_waits_as_long_as_it_may_stops_right_at_the_edge(speed, accel, brake, clearance):
    robot = changed(ROBOT, top_speed_mps=speed, acceleration_mps2=accel, braking_mps2=brake,
                    corridor_clearance_m=clearance + speed ** 2 / (2 * brake))
    for acceleration, waiting_s in ((accel, time_to_runaway_s(robot)),
                                    (0.0, time_to_drift_s(robot))):
        assert drive_m(robot, waiting_s, acceleration) == pytest.approx(
            robot.corridor_clearance_m, abs=5e-3)


def test_a_robot_that_cannot_even_brake_in_its_corridor_has_no_time():
    robot = changed(ROBOT, corridor_clearance_m=0.2)
    assert time_to_runaway_s(robot) == pytest.approx(time_to_drift_s(robot))
    assert time_to_runaway_s(robot) < 0


def test_a_guard_that_is_switched_off_needs_no_time():
    layers = changed(SPEC.layers, safety_pilot_checks=False, dead_man=False, manager_watch=False,
                     ftm=False)
    assert [b.name for b in check(changed(SPEC, layers=layers))] == ["safety_pilot"]


def test_the_numbers_of_the_shipped_robot():
    assert time_to_drift_s(ROBOT) == pytest.approx(1.25)
    assert time_to_obstacle_s(ROBOT) == pytest.approx(0.55)
    assert time_to_intrusion_s(ROBOT, 0.6) == pytest.approx(0.3)
    timing = SPEC.timing
    assert (timing.command_timeout_s, timing.localization_timeout_s, timing.manager_timeout_s,
            timing.detection_silence_timeout_s, timing.scan_timeout_s, timing.dead_man_timeout_s,
            timing.heartbeat_timeout_s) == (0.99, 0.99, 0.99, 0.99, 0.36, 0.405, 0.44)


def test_only_a_repair_pays_for_the_respawn_and_a_given_command_timeout_moves_the_heartbeat():
    assert {b.name: b.respawn_s for b in check(SPEC) if b.respawn_s} == {
        "FTM4": 0.4, "FTM5": 0.4, "FTM7": 0.4}
    timing = derive_timeouts(ROBOT, changed(Timing(), command_timeout_s=0.9))
    assert (timing.command_timeout_s, round(timing.heartbeat_timeout_s, 6)) == (0.9, 0.35)
    timing = derive_timeouts(changed(ROBOT, corridor_clearance_m=20.0), Timing())
    assert timing.heartbeat_timeout_s == 0.5, "at most five periods"


@given(speed=st.floats(0.2, 3.0), brake=st.floats(0.5, 5.0), clearance=st.floats(0.5, 10.0),
       stop=st.floats(0.3, 5.0))
def test_derived_timeouts_always_fit_whatever_the_robot(speed, brake, clearance, stop):
    """If there is time at all; otherwise they are so short that they are refused."""
    robot = changed(ROBOT, top_speed_mps=speed, braking_mps2=brake, stop_distance_m=stop,
                    corridor_clearance_m=clearance)
    spec = changed(SPEC, mobile=robot, timing=derive_timeouts(robot, Timing()))
    detections = tuple(
        changed(d, within_s=timeout_s, parameters=d.parameters | {"timeout_s": timeout_s})
        if "timeout_s" in d.parameters else d
        for d in SPEC.detections
        for timeout_s in [getattr(spec.timing, {
            "DM2": "command_timeout_s", "DM6": "localization_timeout_s"}.get(
                d.name, "heartbeat_timeout_s"))])
    spec = changed(spec, detections=detections)
    if list(find_false_alarms(spec.timing)):
        return
    late = {b.name for b in check(spec) if not b.fits}
    assert late <= {"FTM1", "FTM3", "safety_pilot"}  # these have no timeout that could be derived


@pytest.mark.parametrize(("change", "late"), [
    ({"respawn_s": 0.401}, {"FTM4", "FTM5", "FTM7"}),
    ({"scan_timeout_s": 0.401}, {"blind_pilot"}),
    ({"dead_man_timeout_s": 0.451}, {"dead_man"}),
    ({"manager_timeout_s": 1.101}, {"manager_watch"}),
    ({"detection_silence_timeout_s": 1.101}, {"silent_detection"}),
    ({"actuation_s": 0.151}, {"FTM1", "FTM4", "FTM5", "FTM7", "blind_pilot", "dead_man"}),
])
def test_what_comes_too_late_is_named(change, late):
    assert late == {budget.name for budget in check(with_timing(**change)) if not budget.fits}


def test_all_timeouts_are_guarded_against_false_alarms_and_the_death_of_a_router():
    for field, least in {"heartbeat_timeout_s": 0.42, "command_timeout_s": 0.15,
                         "localization_timeout_s": 0.15, "scan_timeout_s": 0.3,
                         "dead_man_timeout_s": 0.3,
                         "manager_timeout_s": 0.3, "detection_silence_timeout_s": 0.6}.items():
        assert not list(find_false_alarms(with_timing(**{field: least}).timing))
        alarm = next(find_false_alarms(with_timing(**{field: least - 0.01}).timing))
        assert (alarm.path, alarm.value) == (f"$.timing.{field}", (least - 0.01,))
