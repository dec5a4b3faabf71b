"""The localization node by fusion, on the bus with the simulated robot; and the paper's."""

from __future__ import annotations

import asyncio
import math

from rampart.actors.bus import topics as bus_topics
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.control.localization.fused_localization import FusedLocalization
from rampart.actors.osmosis.control.localization.localization import Localization
from rampart.sim.osmosis.simulator import Simulator
from rampart.sim.osmosis.trial.faults import OsmosisFaults
from tests.actors.osmosis.control.localization_drive import field_airport
from tests.osmosis_system import in_system, shipped_system

FIELD = {"system": shipped_system(), "airport": field_airport()}


@in_system(**FIELD)
async def test_it_publishes_the_pose_20_times_a_second_and_says_which_source_is_excluded(system):
    truth, poses = system.hear(topics.TRUTH), system.hear(topics.POSE)
    told = system.hear(topics.LOCALIZATION_STATUS)
    system.start("simulator", Simulator, seed=3)
    system.start("localization", FusedLocalization, bridge_m=2.0)

    async def drive(seconds: float) -> m.LocalizationStatus:
        """Drive in a circle."""
        for _ in range(round(seconds / 0.05)):
            system.say(topics.BASE_COMMAND, m.BaseCommand(0.8, 0.2))
            await asyncio.sleep(0.05)
        return told[-1].message

    def fail(name: str) -> None:
        for order in OsmosisFaults().find(name, 0, topics.ALL).orders(name, math.inf):
            system.say(bus_topics.INJECT, order)

    def error_m() -> float:
        """Worst distance of a pose to the truth nearest in time, less the way in between."""
        worst_m = 0.0
        for _, _, header, pose in poses:
            true = min(truth, key=lambda t: abs(t.header.stamp - header.stamp))
            place = true.message.pose
            off_m = math.dist((pose.x_m, pose.y_m), (place.x_m, place.y_m))
            worst_m = max(worst_m, off_m - 0.8 * abs(true.header.stamp - header.stamp))
        return worst_m

    status = await drive(5.0)
    stamps = [pose.header.stamp for pose in poses]
    assert 95 <= len(stamps) <= 101
    assert max(pose.time_s - pose.header.stamp for pose in poses) < 0.05
    assert stamps == sorted(set(stamps))
    assert error_m() < 0.03
    assert sorted(status.in_use) == ["GPS", "IMU", "absolute pose", "odometry"]
    assert (status.excluded, status.bridged_m) == ((), 0.0)
    assert 0 < status.position_sd_m < 0.03
    assert 0 < status.heading_sd_rad < 0.02
    fail("gps-bias")
    status = await drive(3.0)
    assert status.excluded == (("GPS", "moves differently from the others, 0.6 m"),)
    assert error_m() < 0.05
    fail("absolute-pose-dropout")
    await drive(5.0)  # 4 m: twice as far as it bridges
    assert truth[-1].header.stamp - poses[-1].header.stamp > 1.0


@in_system(**FIELD)
async def test_the_papers_localization_passes_on_what_is_newer_and_can_be(system):
    poses = system.hear(topics.POSE)
    system.start("localization", Localization)
    await system.settle()
    bad = {2: math.inf, 3: 1e9, 4: math.nan, 5: 0.05}
    for i in range(10):
        system.say(topics.ABSOLUTE_POSE, m.Pose(math.nan if i == 6 else float(i), 0.0, 0.0),
                   stamp_s=bad.get(i))
        await asyncio.sleep(0.05)
    assert [pose.message.x_m for pose in poses] == [0.0, 1.0, 7.0, 8.0, 9.0]
