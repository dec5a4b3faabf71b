"""DM1: the robot that would not stop before the grass, and a GPS that is silent."""

from __future__ import annotations

import asyncio
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rampart.actors.detection.freshness import FreshnessMonitor
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.detection.area.prohibited_area import (
    FenceLimits,
    FenceMonitor,
    ProhibitedArea,
    half_diagonal_m,
    intrusion,
)
from rampart.actors.osmosis.messages import GpsFix
from rampart.testing import Ear, play, table
from tests.actors.osmosis.detection.lane import LANE
from tests.osmosis_system import in_system, shipped_system

LIMITS = FenceLimits(half_diagonal_m=0.473, reaction_s=0.3, braking_mps2=2.0)
ACCURACY_M = 0.05
HALF_LANE_M = 2.5


def lane(_x_m: float, y_m: float) -> float:
    """Signed distance to the grass on both sides of a lane along x, 5 m wide."""
    return HALF_LANE_M - abs(y_m)


def fix(y_m: float, speed_mps: float, course_deg: float, x_m: float = 0.0) -> GpsFix:
    course = math.radians(course_deg)
    return GpsFix(x_m, y_m, speed_mps * math.cos(course), speed_mps * math.sin(course), ACCURACY_M)


@pytest.mark.parametrize(("y_m", "speed_mps", "course_deg", "alarm"), **table({
    "skirting it, nearly parallel, outward": (1.5, 1.0, 20.0, False),
    "straight at the edge, no room left": (1.5, 1.0, 90.0, True),
    "straight at the edge from 1 m aside": (1.0, 1.0, 90.0, False),
    "standing with a corner nearly on the grass": (2.0, 0.0, 0.0, True),
    "the same, driving away from it": (2.0, 0.5, -90.0, True),
    "standing as near as is allowed": (1.95, 0.0, 0.0, False),
}))
def test_alarm_in_a_lane_of_5_m(y_m, speed_mps, course_deg, alarm):
    assert bool(intrusion(fix(y_m, speed_mps, course_deg), lane, LIMITS)) is alarm


def test_a_corner_in_the_way_is_found_though_both_ends_of_the_path_are_clear():
    def post(x_m: float, y_m: float) -> float:
        return math.hypot(x_m - 0.6, y_m - 0.5) - 0.05

    assert "would touch" in intrusion(fix(0.0, 2.0, 0.0), post, LIMITS)
    assert intrusion(fix(0.0, 2.0, 180.0), post, LIMITS) == ""


@given(y_m=st.floats(-2.4, 2.4), speed_mps=st.floats(0.0, 3.0), course_deg=st.floats(-180, 180))
def test_a_robot_that_brakes_at_the_alarm_never_touches_the_grass(y_m, speed_mps, course_deg):
    """Drive on in a straight line until the first alarm, react, brake: the footprint stays off."""
    course = math.radians(course_deg)
    step_s = 0.1
    position = y_m
    if intrusion(fix(position, speed_mps, course_deg), lane, LIMITS):
        return  # it starts too near; there is nothing to prevent any more
    for _ in range(200):
        position += speed_mps * math.sin(course) * step_s
        if intrusion(fix(position, speed_mps, course_deg), lane, LIMITS):
            break
    else:
        assert abs(math.sin(course)) * speed_mps < 0.2
        return
    # The alarm came with this fix; its reaction time includes the period since the last one.
    rest_s = LIMITS.reaction_s - step_s
    stop = position + math.sin(course) * (
        speed_mps * rest_s + speed_mps**2 / (2 * LIMITS.braking_mps2))
    assert lane(0.0, stop) >= LIMITS.half_diagonal_m


def fence() -> FenceMonitor:
    return FenceMonitor(lane, LIMITS, FreshnessMonitor("GPS", 0.3, 0.2, 0.0, 0.5), hold_s=0.3)


# m in the middle, e at the edge, c cleared by less than the hysteresis; n a fix of no numbers,
# o the first fix once more, b a fix with a bad accuracy, v one with a velocity that cannot be;
# in the middle with a wrong stamp: + far ahead, i infinite, t no number
FIXES = {
    "m": fix(0.0, 1.0, 0.0), "o": fix(0.0, 1.0, 0.0), "e": fix(2.0, 0.0, 0.0),
    "c": fix(1.95, 0.0, 0.0), "n": GpsFix(math.nan, 0.0, 0.0, 0.0, 0.05),
    "b": GpsFix(0.0, 0.0, 0.0, 0.0, 4.0), "w": GpsFix(0.0, 0.0, 0.0, 0.0, -1.0),
    "v": GpsFix(0.0, 0.0, 1.7e308, 1e155, 0.05),
}
STAMPS = {"o": 0.0, "+": 1e9, "i": math.inf, "t": math.nan}


@pytest.mark.parametrize(("events", "expected"), **table({
    "at the edge, at once": ("mmem", "--AA"),
    "back on the lane for long enough": ("memmmm", "-AAAA-"),
    "back by less than the hysteresis": ("mecccccc", "-AAAAAAA"),
    "no fix ever": ("......", "-----A"),
    "the fixes cease, and come again": ("mm.....mmm", "----AAAAA-"),
    "fixes without numbers are none, nor a negative accuracy": ("mnwnwn", "---AAA"),
    "a velocity that cannot be is none": ("mvvvvv", "---AAA"),
    "and does no harm to those after it": ("mvmmvm", "------"),
    "fixes from the future or of no time are none": ("m+iti+", "---AAA"),
    "and shut out none": ("+mm+mm", "------"),
    "a fix from the future does not say that it is safe again": ("me++++", "-AAAAA"),
    "a frozen receiver": ("moooooo", "---AAAA"),
    "a receiver that has lost its accuracy is no barrier": ("mb", "-A"),
    "at the edge, then blind": ("e.....", "AAAAAA"),
}))
def test_fence_timeline(events, expected):
    monitor = fence()

    def handle(event: str, now_s: float) -> None:
        monitor.fix(FIXES.get(event, FIXES["m"]), STAMPS.get(event, now_s), now_s)

    assert play(monitor, handle, events) == expected


@in_system(system=shipped_system(), airport=LANE)
async def test_the_actor_warns_in_time_by_the_margins_of_the_shipped_system(system):
    spec, ear = shipped_system(), system.start("ear", Ear)
    detection = next(d for d in spec.detections if d.name == "DM1")
    system.start("DM1", ProhibitedArea, **detection.parameters)
    y_m = 0.0
    for _ in range(20):  # along the lane, then straight at its edge with top speed
        system.say(topics.GPS, m.GpsFix(0.0, 0.0, 1.0, 0.0, 0.05))
        await asyncio.sleep(0.1)
    assert ear.states == ["idle"]
    while ear.states == ["idle"]:
        y_m += 0.1
        system.say(topics.GPS, m.GpsFix(20.0, y_m, 0.0, 1.0, 0.05))
        await asyncio.sleep(0.1)
    room_m = HALF_LANE_M - y_m - half_diagonal_m(spec.robot)
    brakes_m = 1.0 / (2 * spec.robot.braking_mps2)
    assert room_m >= spec.timing.arbitration_s + spec.timing.actuation_s + brakes_m
    assert room_m < 0.8
