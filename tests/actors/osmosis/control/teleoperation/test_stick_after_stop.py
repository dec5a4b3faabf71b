"""A stick that is held while the robot is stopped does nothing when the stop ends."""

import asyncio

import pytest

from rampart.actors.osmosis import topics
from tests.actors.osmosis.driven_robot import driven
from tests.virtual_time import within

STANDING_MPS = 0.02


@pytest.mark.parametrize("restarted", [
    "", "safety_pilot", "teleoperation", "teleoperation, back after the stop"])
@within(driven)
async def test_a_stick_held_all_through_an_emergency_stop_drives_only_after_it_was_let_go(
        robot, restarted):
    robot.hold(0.75)
    await robot.until(lambda: robot.speed_mps > 0.7)
    robot.system.inject(topics.GPS, "drop", 2.0)
    await robot.until(lambda: "RM1" in robot.manager.latched)
    late = "back" in restarted
    if late:
        await robot.system.kill("teleoperation")
    await robot.until(lambda: robot.speed_mps < STANDING_MPS)
    if restarted and not late:
        await robot.restart(restarted)
    await robot.reset()
    if late:
        robot.system.start_node("teleoperation")
    assert await robot.fastest(1.5) < STANDING_MPS
    robot.let_go()
    await asyncio.sleep(0.1)
    robot.hold(0.75)
    assert await robot.fastest(1.0) > 0.7
