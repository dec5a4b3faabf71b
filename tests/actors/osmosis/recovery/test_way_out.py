"""A robot that stands in a prohibited area is driven out by its operator, and no other way."""

import asyncio
import math
from contextlib import asynccontextmanager

import pytest

from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.airport.formats import load_airport
from rampart.actors.osmosis.messages import Way
from rampart.actors.osmosis.recovery.emergency_stop import TOP_SPEED_MPS, Look, WayOut
from tests.actors.osmosis.driven_robot import driven
from tests.virtual_time import within

AIRPORT = load_airport("vallombre")
STANDING = 0.02
DEPTH_M = 0.4


def depth_m(robot):
    return -AIRPORT.prohibited_distance_m(robot.truth.pose.x_m, robot.truth.pose.y_m)


async def ask(robot, order="1"):
    answers = robot.system.hear(topics.WAY_OUT_ANSWER)
    robot.system.say(topics.WAY_OUT, m.WayOutRequest(order, "tester", "a reason"), "tool")
    await robot.until(lambda: answers)
    return answers


@asynccontextmanager
async def inside():
    """Drive the robot into the grass without a brake, and stop it there."""
    async with driven(without=("RM1",)) as robot:
        robot.hold(0.0, 0.5)
        out_rad = math.pi  # to the west there is grass beside the apron
        await robot.until(lambda: abs(math.remainder(
            robot.truth.pose.yaw_rad - out_rad, math.tau)) < 0.15)
        robot.hold(1.0)
        await robot.until(lambda: depth_m(robot) > DEPTH_M - 0.15, 40.0)
        robot.let_go()
        await robot.until(lambda: robot.speed_mps < STANDING)
        robot.system.start_node("RM1")
        await robot.until(lambda: "RM1" in robot.manager.latched)
        await asyncio.sleep(1.0)
        assert depth_m(robot) > 0.2
        yield robot


@within(inside)
async def test_the_operator_drives_the_robot_out_slowly_and_resets_the_emergency_stop(robot):
    robot.hold(-1.0)
    assert await robot.fastest(1.0) < STANDING, "not without the operator's word"
    robot.let_go()
    answers = await ask(robot)
    assert answers[0].message.granted
    await asyncio.sleep(0.5)
    before_m = depth_m(robot)
    robot.hold(1.0)
    assert await robot.fastest(1.5) < STANDING, "the wrong direction"
    assert depth_m(robot) == pytest.approx(before_m, abs=0.01)
    robot.hold(-1.0)
    speeds = [await robot.fastest(1.0)]
    assert speeds[0] > 0.1
    while answers[-1].message.granted:
        speeds.append(await robot.fastest(0.5))
    assert max(speeds) < TOP_SPEED_MPS + 0.03
    assert answers[-1].message.is_out, answers[-1].message
    await asyncio.sleep(0.5)
    assert "RM1" in robot.manager.activated
    assert depth_m(robot) < -0.5
    assert await robot.fastest(1.0) < STANDING, "the stick is still held"
    robot.let_go()
    await robot.reset()


@pytest.mark.parametrize("lost", ["safety_pilot", "ftm_manager", "RM1", "gps"])
@within(inside)
async def test_whatever_is_lost_meanwhile_stops_the_robot(robot, lost):
    answers = await ask(robot)
    await asyncio.sleep(0.5)
    robot.hold(-1.0)
    assert await robot.fastest(1.0) > 0.1
    if lost == "gps":
        robot.system.inject(topics.GPS, "drop", 100.0)
    else:
        await robot.system.kill(lost)
    before_m = depth_m(robot)
    await asyncio.sleep(1.3)
    assert robot.speed_mps < STANDING
    assert abs(depth_m(robot) - before_m) < 0.3
    if lost in robot.system.layout.members:
        robot.system.start_node(lost)
        assert await robot.fastest(3.0) < STANDING, "nor when it is back"
    robot.let_go()
    if lost != "RM1":
        await robot.until(lambda: not answers[-1].message.granted)
    await robot.until(lambda: "RM1" in robot.manager.activated)


@within(driven)
async def test_it_is_refused_while_the_robot_is_not_stopped_inside(robot):
    answers = await ask(robot)
    assert not answers[0].message.granted
    assert "not in force" in answers[0].message.reason
    robot.system.inject(topics.GPS, "drop", 1.5)
    await robot.until(lambda: "RM1" in robot.manager.latched)
    await asyncio.sleep(2.0)
    answers = await ask(robot, "2")
    assert not answers[-1].message.granted
    assert "reset the emergency stop" in answers[-1].message.reason


def area_to_the_west(x_m, _y_m):
    return x_m


def looked(now_s=0.0, **readings):
    return Look(**{"pose": (-0.4, 0.0, 0.0), "pose_s": now_s, "fix": (-0.4, 0.0), "fix_s": now_s,
                   "stick_s": now_s, "pilot_s": now_s, "wheels_radps": 0.0, "wheels_s": now_s,
                   **readings})


@pytest.mark.parametrize(("readings", "words"), [
    ({}, ""), ({"pose_s": -1.0}, "pose"), ({"fix_s": -1.0}, "GPS"), ({"wheels_s": -1.0}, "moves"),
    ({"wheels_radps": 1.0}, "moves"), ({"fix": (-2.0, 0.0)}, "differ"),
    ({"fix": (math.nan, 0.0)}, "differ"), ({"pose": (math.nan, 0.0, 0.0)}, "differ"),
    ({"fix": (0.7, 0.0), "pose": (0.7, 0.0, 0.0)}, "reset")])
def test_when_a_way_out_is_granted(readings, words):
    refusal = WayOut(area_to_the_west, 0.6, 0.75, 0.0).refusal(looked(**readings), 0.0)
    assert words in refusal
    assert bool(words) == bool(refusal)


@pytest.mark.parametrize(("yaw_rad", "way"), [
    (0.0, Way.FORWARDS), (math.pi, Way.BACKWARDS), (math.pi / 2, Way.NEITHER),
    (1.0, Way.FORWARDS), (2.2, Way.BACKWARDS)])
def test_which_way_leads_out(yaw_rad, way):
    out = WayOut(area_to_the_west, 0.6, 0.75, 0.0)
    assert out.look(looked(pose=(-0.4, 0.0, yaw_rad)), 0.0) == ""
    assert out.way is way


def test_a_robot_that_gets_deeper_or_gets_out_or_waits_is_not_driven_on():
    out = WayOut(area_to_the_west, 0.6, 0.75, 0.0)
    assert out.refusal(looked(), 0.0) == ""
    assert out.look(looked(fix=(-0.5, 0.0)), 0.0) == ""
    assert "deeper" in out.look(looked(fix=(-0.6, 0.0)), 0.0)
    assert out.look(looked(fix=(0.8, 0.0), pose=(0.8, 0.0, 0.0)), 0.0)
    assert out.is_out
    released = WayOut(area_to_the_west, 0.6, 0.75, 0.0)
    assert released.look(looked(), 0.0) == ""
    assert "released" in released.look(looked(1.0, stick_s=0.0), 1.0)
    late = WayOut(area_to_the_west, 0.6, 0.75, 0.0)
    assert late.look(looked(9.0, stick_s=0.0), 9.0) == ""
    assert "not pressed" in late.look(looked(11.0, stick_s=0.0), 11.0)
