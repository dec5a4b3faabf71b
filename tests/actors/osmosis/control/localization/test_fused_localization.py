"""The localization node by fusion, on the bus with the simulated robot."""

from __future__ import annotations

import asyncio
import math

import pytest

from rampart.actors.bus import messages as bm
from rampart.actors.bus import topics as bus_topics
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.control.localization.fused_localization import FusedLocalization
from rampart.actors.osmosis.control.localization.localization import Localization
from rampart.actors.runtime.actor import Actor, Context, Header, on
from rampart.sim.osmosis.simulator import Simulator
from rampart.sim.osmosis.trial.faults import OsmosisFaults
from rampart.testing import run
from tests.actors.osmosis.control.localization_drive import field_airport
from tests.osmosis_system import System, shipped_system


class Ear(Actor):
    """Drives in a circle, orders faults, and compares the pose with the truth."""

    outputs = (topics.BASE_COMMAND, bus_topics.INJECT)

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self.truth: list[tuple[float, m.Pose]] = []
        self.poses: list[tuple[float, float, int, m.Pose]] = []
        self.status: m.LocalizationStatus | None = None

    @on(topics.TRUTH)
    def hear_truth(self, message: m.GroundTruth, header: Header) -> None:
        self.truth.append((header.stamp, message.pose))

    @on(topics.POSE)
    def pose(self, message: m.Pose, header: Header) -> None:
        self.poses.append((self.clock.now(), header.stamp, header.incarnation, message))

    @on(topics.LOCALIZATION_STATUS)
    def hear_status(self, message: m.LocalizationStatus, _header: Header) -> None:
        self.status = message

    async def drive(self, seconds: float) -> None:
        for _ in range(round(seconds / 0.05)):
            self.publish(topics.BASE_COMMAND, m.BaseCommand(0.8, 0.2))
            await asyncio.sleep(0.05)

    def fail(self, name: str, number: str = "f") -> None:
        for order in OsmosisFaults().find(name, 0, topics.ALL).orders(number, math.inf):
            self.publish(bus_topics.INJECT, order)

    def error_m(self, since_s: float) -> float:
        """Worst distance of a pose to the truth nearest in time, less the way in between."""
        worst_m = 0.0
        for at_s, stamp_s, _, pose in self.poses:
            if at_s >= since_s:
                true_s, true = min(self.truth, key=lambda t: abs(t[0] - stamp_s))
                off_m = math.dist((pose.x_m, pose.y_m), (true.x_m, true.y_m))
                worst_m = max(worst_m, off_m - 0.8 * abs(true_s - stamp_s))
        return worst_m


def play(scenario, **parameters):
    async def whole():
        async with System(system=shipped_system(), airport=field_airport()) as system:
            ear = system.start("ear", Ear)
            system.start("simulator", Simulator, seed=3)
            system.start("localization", FusedLocalization, **parameters)
            await system.settle()
            return await scenario(system, ear)

    return run(whole)


def test_it_publishes_the_pose_20_times_a_second_with_the_time_at_which_it_was_true():
    async def scenario(_system, ear):
        await ear.drive(5.0)
        ages = [at_s - stamp_s for at_s, stamp_s, _, _ in ear.poses]
        stamps = [stamp_s for _, stamp_s, _, _ in ear.poses]
        assert 95 <= len(ear.poses) <= 101
        assert max(ages) < 0.05
        assert stamps == sorted(set(stamps))
        assert ear.error_m(0.0) < 0.03
        assert ear.status is not None
        assert sorted(ear.status.in_use) == ["GPS", "IMU", "absolute pose", "odometry"]
        assert ear.status.excluded == ()
        assert 0 < ear.status.position_sd_m < 0.03
        assert 0 < ear.status.heading_sd_rad < 0.02
        assert ear.status.bridged_m == 0.0

    play(scenario)


def test_it_says_which_source_it_has_excluded_and_why():
    async def scenario(_system, ear):
        await ear.drive(3.0)
        ear.fail("gps-bias")
        await ear.drive(3.0)
        assert ear.status.excluded == (("GPS", "moves differently from the others, 0.6 m"),)
        assert ear.error_m(0.0) < 0.05

    play(scenario)


def test_without_both_positions_it_bridges_and_then_falls_silent_and_comes_back():
    async def scenario(_system, ear):
        await ear.drive(2.0)
        ear.fail("gps-dropout", "a")
        ear.fail("absolute-pose-dropout", "b")
        before_m = ear.status.position_sd_m
        await ear.drive(3.0)
        assert ear.poses[-1][0] > ear.truth[-1][0] - 0.1
        assert 1.5 < ear.status.bridged_m < 3.0
        assert ear.status.position_sd_m > before_m
        await ear.drive(3.0)
        silent_s = ear.poses[-1][1]
        assert ear.truth[-1][0] - silent_s > 1.0
        for number in "ab":
            ear.publish(bus_topics.INJECT, bm.Injection(number, *(
                ("summit_xl/gps", "drop") if number == "a" else
                ("summit_xl/absolute_pose", "drop")), 0.0))
        await ear.drive(2.0)
        assert ear.poses[-1][0] > ear.truth[-1][0] - 0.1
        assert ear.error_m(0.0) < 0.3

    play(scenario, bridge_m=3.0)


@pytest.mark.parametrize("broken", ["", "absolute-pose-dropout", "gps-dropout", "imu-dropout",
                                    "odom-dropout"])
def test_a_respawned_node_knows_the_pose_at_once_whatever_single_source_is_missing(broken):
    async def scenario(system, ear):
        await ear.drive(3.0)
        if broken:
            ear.fail(broken)
        await ear.drive(2.0)
        await system.kill("localization")
        await ear.drive(0.5)
        died_s = ear.clock.now()
        system.start("localization", FusedLocalization)
        await ear.drive(4.0)
        first_s = next(at_s for at_s, _, life, _ in ear.poses if life == 2)
        assert first_s - died_s < 0.36
        assert ear.error_m(died_s) < 0.1

    play(scenario)


class Device(Actor):
    outputs = (topics.ABSOLUTE_POSE,)


@pytest.mark.parametrize("stamp_s", [1e9, math.inf, math.nan])
def test_the_papers_localization_outlives_a_stamp_from_the_future(stamp_s):
    async def whole():
        async with System(system=shipped_system(), airport=field_airport()) as system:
            ear, device = system.start("ear", Ear), system.start("device", Device)
            system.start("localization", Localization)
            await system.settle()
            for i in range(10):
                device.publish(topics.ABSOLUTE_POSE, m.Pose(float(i), 0.0, 0.0),
                               stamp=stamp_s if i == 3 else None)
                await asyncio.sleep(0.05)
            return [pose.x_m for *_, pose in ear.poses]

    assert run(whole) == [0.0, 1.0, 2.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0]
