"""The gateway in virtual time: what it passes on, and what it does not."""

from __future__ import annotations

import asyncio

import pytest

from rampart.actors.bus.topics import DIAGNOSTIC
from rampart.actors.ros2.messages import GRAPH
from rampart.testing import VirtualSystem, run

SYSTEM = """
name = "guarded"
title = "A robot in ROS 2"

[[node]]
name = "gateway"
actor = "rampart.actors.ros2.gateway:Gateway"
kind = "non-control"
respawn = "R_RESTART"

[[node]]
name = "driver"
actor = "tests.actors.ros2.robot:Driver"
kind = "control"
respawn = "R_RESTART"

[[node]]
name = "base"
actor = "tests.actors.ros2.robot:Base"
kind = "world"

[[node]]
name = "manager"
actor = "rampart.manager.actor:FtmManager"
kind = "manager"

[[detection]]
name = "D_CRASH"
title = "A node has crashed"
actor = "rampart.actors.detection.watchdog:Watchdog"
parameters = { watch = ["driver", "gateway"], timeout_s = "heartbeat_timeout_s" }

[[recovery]]
name = "R_RESTART"
title = "Restart it"
actor = "rampart.actors.recovery.respawn:Respawn"
kind = "masking"

[[mechanism]]
name = "M_CRASH"
detect = "D_CRASH"
recover = "R_RESTART"
event = "crash"
against = { within_s = 5.0, hazard = "the robot stands" }

[[event]]
name = "crash"

[orders.safer]

[[ros2]]
subscribe = "/odom"
type = "nav_msgs/msg/Odometry"
to = "base/odometry"
frame = "odom"

[[ros2]]
publish = "/cmd_vel"
type = "geometry_msgs/msg/Twist"
from = "base/wanted"
stop_after_s = 0.2
"""


@pytest.fixture
def guarded(tmp_path):
    def write(more: str = "", base: str = SYSTEM):
        path = tmp_path / "guarded.toml"
        path.write_text(base + more)
        return path

    return write


def test_what_the_system_says_reaches_ros_2_and_what_that_says_the_system(guarded):
    async def scenario():
        async with VirtualSystem.load(guarded()) as system:
            base = system.start_node("base")
            gateway = system.start_node("gateway")
            odometry = system.hear(gateway.chosen_topic("base/odometry"))
            system.start_node("driver")
            await asyncio.sleep(2.0)
            assert len(base.heard) == pytest.approx(39, abs=2)
            assert set(base.heard) == {0.5}
            assert len(odometry) == pytest.approx(39, abs=2)
            last = odometry[-1]
            assert last.message.x_m == pytest.approx(base.x_m)
            assert last.message.linear_mps == 0.5

    run(scenario)


def test_when_the_system_falls_silent_ros_2_is_told_zeros(guarded):
    async def scenario():
        async with VirtualSystem.load(guarded()) as system:
            base = system.start_node("base")
            system.start_node("gateway")
            system.start_node("driver")
            await asyncio.sleep(1.0)
            await system.kill("driver")
            await asyncio.sleep(0.35)
            assert base.heard[-1] == 0.0
            await asyncio.sleep(10.0)
            assert base.heard.count(0.0) == 20

    run(scenario)


def test_the_graph_says_who_is_there_and_when_a_process_dies_it_is_gone(guarded):
    async def scenario():
        async with VirtualSystem.load(guarded()) as system:
            system.start_node("gateway")
            graph = system.hear(GRAPH, "gateway")
            base = system.start_node("base")
            await asyncio.sleep(1.5)
            assert set(graph[-1].message.nodes) == {"/rampart", "/robot/base"}
            assert graph[-1].message.problems == ()
            del base
            await system.kill("base")
            await asyncio.sleep(0.5)
            assert set(graph[-1].message.nodes) == {"/rampart"}

    run(scenario)


def test_a_second_publisher_is_refused_and_told(guarded):
    async def scenario():
        async with VirtualSystem.load(guarded()) as system:
            gateway = system.start_node("gateway")
            odometry = system.hear(gateway.chosen_topic("base/odometry"))
            told = system.hear(DIAGNOSTIC, "gateway")
            base = system.start_node("base")
            await asyncio.sleep(0.5)
            base.publisher("/odom", "nav_msgs/msg/Odometry")
            other = base.publisher("/odom", "nav_msgs/msg/Odometry")
            message = base.types.blank("nav_msgs/msg/Odometry")
            message.header.frame_id = "odom"
            message.pose.pose.position.x = 99.0
            other(message)
            await asyncio.sleep(0.5)
            assert 99.0 not in {heard.message.x_m for heard in odometry}
            assert "two publishers, /robot/base and /robot/base" in told[0].message.reason

    run(scenario)
