"""Single nodes on a virtual bus: pilot, mission and flight controller."""

import asyncio
import math
import random

import pytest
from flights import SYSTEM
from quadrotor import topics as t
from quadrotor.control import G_MPS2
from quadrotor.vehicle import HOVER_N

from rampart.testing import VirtualSystem, run

LEVEL = (1.0, 0.0, 0.0, 0.0)
DICE = random.Random(5)


def noisy():
    return DICE.gauss(0.0, 1e-4)  # what repeats itself is taken for stuck


class Bench:
    """A pilot, and its inputs as a test sets them."""

    def __init__(self, system, name="pilot"):
        self.system = system
        self.status = system.hear(t.PILOT)
        self.rotors = system.hear(t.ROTORS)
        system.start_node(name)

    async def feed(self, seconds, *, estimate=True, setpoint=True, up=0.0, height_m=5.0,
                   obeys=""):
        for _ in range(round(seconds / 0.02)):
            for topic in t.IMUS:
                reading = t.Imu(noisy(), 0.0, 0.0, 0.0, 0.0, G_MPS2 + noisy())
                self.system.say(topic, reading, "world")
            self.system.say(t.HEADING, t.Heading(0.0), "world")
            self.system.say(t.BAROMETER, t.Barometer(height_m + noisy()), "world")
            if obeys:
                self.system.say(t.ESC, t.EscStatus(0.0, True, obeys, (HOVER_N,) * 4), "world")
            if estimate:
                self.system.say(t.ESTIMATE, t.Estimate(
                    noisy(), 0.0, height_m, 0.0, 0.0, 0.0, 0.0, LEVEL, 0.0), "estimator")
            if setpoint:
                self.system.say(t.SETPOINT, t.Setpoint(True, 0.0, 0.0, up, 0.0),
                                "flight_controller")
            await asyncio.sleep(0.02)
        return self.status[-1].message if self.status else None

    async def order(self, mode, source):
        self.system.say(t.PILOT_ORDER, t.PilotOrder(mode), source)
        return await self.feed(0.2)


def on_the_bench(scenario):
    async def play():
        async with VirtualSystem.load(SYSTEM) as system:
            bench = Bench(system)
            assert (await bench.feed(0.5)).landed
            assert not (await bench.feed(0.3, up=1.0)).landed
            await scenario(bench)

    run(play)


def test_who_is_missing_decides_what_the_pilot_flies_by():
    async def scenario(bench):
        assert (await bench.feed(0.5)).source == "setpoint"
        assert (await bench.feed(0.5, setpoint=False)).source == "estimate"
        assert (await bench.feed(0.5, setpoint=False, estimate=False)).source == "own sensors"
        assert (await bench.feed(0.5)).source == "setpoint"

    on_the_bench(scenario)


def test_without_anybody_it_goes_down_after_a_while():
    async def scenario(bench):
        await bench.feed(1.5, setpoint=False, estimate=False)
        holds_n = sum(bench.rotors[-1].message.thrust_n)
        await bench.feed(1.5, setpoint=False, estimate=False)
        assert sum(bench.rotors[-1].message.thrust_n) < holds_n - 0.5

    on_the_bench(scenario)


@pytest.mark.parametrize("value", [math.nan, math.inf, 50.0])
def test_a_setpoint_that_makes_no_sense_is_refused(value):
    async def scenario(bench):
        status = await bench.feed(0.5, up=value)
        assert status.refused == 1.0
        assert status.source == "estimate"
        assert all(map(math.isfinite, bench.rotors[-1].message.thrust_n))

    on_the_bench(scenario)


def test_the_strictest_order_holds_until_its_own_source_takes_it_back():
    async def scenario(bench):
        assert (await bench.order("LAND", "R_LAND")).mode == "LAND"
        assert (await bench.order("HOVER", "R_HOVER")).mode == "LAND"
        assert (await bench.order("NORMAL", "R_HOVER")).mode == "LAND"
        assert (await bench.order("NORMAL", "R_LAND")).mode == "NORMAL"
        assert (await bench.order("somewhere", "R_LAND")).mode == "NORMAL"

    on_the_bench(scenario)


def test_who_asks_for_little_and_feels_his_weight_stands_and_after_an_order_stays():
    async def scenario(bench):
        assert (await bench.feed(1.0, up=-4.0)).landed
        assert bench.rotors[-1].message.thrust_n == (0.0,) * 4
        assert not (await bench.feed(0.3, up=1.0)).landed
        await bench.order("LAND", "R_LAND")
        assert (await bench.feed(4.0)).landed
        await bench.order("NORMAL", "R_LAND")
        assert (await bench.feed(1.0, up=2.0)).landed

    on_the_bench(scenario)


def test_a_pilot_whom_the_rotors_do_not_obey_commands_on_and_says_nothing():
    async def scenario(bench):
        said, told = len(bench.status), len(bench.rotors)
        await bench.feed(0.5, obeys="reserve")
        assert len(bench.status) <= said + 1
        assert len(bench.rotors) > told + 40
        await bench.feed(0.5)  # without the speed controllers it assumes to fly
        assert len(bench.status) > said + 5

    on_the_bench(scenario)


def test_who_does_not_fly_does_not_take_the_others_flight_for_the_ground():
    async def scenario(bench):
        await bench.feed(1.0, up=-4.0, obeys="reserve")
        assert bench.rotors[-1].message.thrust_n != (0.0,) * 4

    on_the_bench(scenario)


def test_the_reserve_speaks_when_it_flies():
    async def play():
        async with VirtualSystem.load(SYSTEM) as system:
            bench = Bench(system, "reserve")
            assert await bench.feed(1.0) is None
            assert await bench.feed(1.0, obeys="pilot") is None
            assert (await bench.feed(0.5, obeys="reserve")).mode == "NORMAL"

    run(play)


def test_a_pilot_that_was_killed_on_the_ground_stays_there():
    async def scenario(bench):
        assert (await bench.feed(1.0, up=-4.0)).landed
        await bench.system.kill("pilot")
        bench.system.start_node("pilot")
        assert (await bench.feed(0.5, up=-4.0)).landed

    on_the_bench(scenario)


def test_the_controller_says_nothing_about_an_estimate_that_is_no_number():
    async def play():
        async with VirtualSystem.load(SYSTEM) as system:
            said = system.hear(t.SETPOINT)
            system.start_node("flight_controller")
            await system.settle()
            system.say(t.GOAL, t.Goal(True, 0.0, 0.0, 5.0, 0.0, 3.0, 1.0), "mission")
            for x_m in (1.0, math.nan, math.inf):
                system.say(t.ESTIMATE, t.Estimate(
                    x_m, 0.0, 5.0, 0.0, 0.0, 0.0, 0.0, LEVEL, 0.0), "estimator")
                await asyncio.sleep(0.02)
            assert len(said) == 1
            assert said[0].message.accel_x_mps2 < 0

    run(play)


def test_a_mission_goes_on_with_the_step_at_which_it_was_killed():
    async def play():
        async with VirtualSystem.load(SYSTEM) as system:
            steps = system.hear(t.MISSION)
            system.start_node("mission")
            await system.settle()

            async def at(x_m, y_m, z_m):
                system.say(t.PILOT, t.PilotStatus(
                    "NORMAL", "setpoint", False, 0.0, LEVEL, 3, 0.0, 0.0), "pilot")
                system.say(t.ESTIMATE, t.Estimate(
                    x_m, y_m, z_m, 0.0, 0.0, 0.0, 0.0, LEVEL, 0.0), "estimator")
                await asyncio.sleep(0.5)
                return steps[-1].message.step

            await asyncio.sleep(2.1)
            assert await at(0.0, 0.0, 0.0) == "takeoff"
            assert await at(0.0, 0.0, 5.0) == "leg 1"
            assert await at(12.0, 0.0, 6.0) == "leg 2"
            await system.kill("mission")
            system.start_node("mission")
            assert await at(12.0, 1.0, 6.0) == "leg 2"

    run(play)


@pytest.mark.parametrize(("node", "wrong"), [
    ("mission", {"waypoints": []}), ("mission", {"waypoints": [[0, 0, -3]]}),
    ("mission", {"speed_mps": 50}), ("pilot", {"descent_mps": 3}), ("pilot", {"colour": 1}),
    ("world", {"charge": 0}), ("world", {"wind_mps": -1})])
def test_parameters_that_make_no_sense_are_refused(node, wrong):
    async def play():
        async with VirtualSystem.load(SYSTEM) as system:
            with pytest.raises(ValueError, match=next(iter(wrong))):
                system.start_node(node, **wrong)

    run(play)
