"""One joystick drives; its release, its silence and an emergency stop are one stop each."""

import asyncio

import pytest

from rampart.actors.bus import topics as bus_topics
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.control.teleoperation.teleoperation import Teleoperation, stick_twist
from tests.actors.osmosis.driven_robot import driven
from tests.osmosis_system import in_system, shipped_system
from tests.virtual_time import within

STOP, LEFT = (0.0, 0.0), (1.0, 2.0)


@in_system(system=shipped_system())
async def test_the_first_who_holds_drives_until_it_lets_go_or_falls_silent(system):
    commands, told = system.hear(topics.TELEOP_COMMAND), system.hear(bus_topics.DIAGNOSTIC)
    system.start("teleoperation", Teleoperation)
    await system.settle()

    async def hold(seconds, *sources):
        for _ in range(round(seconds / 0.05)):
            for source in sources:
                stick = m.Joystick(1.0, 1.0 if source == "tool" else -1.0, True)
                system.say(topics.JOYSTICK, stick, source)
            await asyncio.sleep(0.05)

    def driven():
        found = [(c.message.linear_mps, c.message.angular_radps) for c in commands]
        commands.clear()
        return found

    for source in ("tool", "page"):
        system.say(topics.JOYSTICK, m.Joystick(0.0, 0.0, False), source)
    await hold(1.0, "tool", "page")
    assert driven() == [LEFT] * 20
    assert "tool has the stick" in told[-1].message.reason
    assert told[-1].message.offender == "page"
    system.say(topics.JOYSTICK, m.Joystick(0.0, 0.0, False), "tool")
    system.say(topics.JOYSTICK, m.Joystick(0.3, 0.0, False), "tool")
    await asyncio.sleep(0.5)
    assert driven() == [STOP], "one stop, then silence"
    await hold(1.0, "tool")
    await asyncio.sleep(1.0)
    assert driven() == [*[LEFT] * 20, STOP]
    assert "silent for 0.3 s" in told[-1].message.reason


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


@pytest.mark.parametrize(("stick", "expected"), [
    (m.Joystick(-0.5, 0.5, True), m.StickTwist(-0.4, 0.5)),
    (m.Joystick(7.0, -7.0, True), m.StickTwist(0.8, -1.0)),
    (m.Joystick(1.0, 0.0, False), None),
    (m.Joystick(float("nan"), 0.0, True), None)])
def test_the_stick_is_a_velocity_only_while_the_dead_man_is_held(stick, expected):
    assert stick_twist(stick, 0.8, 1.0) == expected
