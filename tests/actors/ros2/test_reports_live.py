"""Detections of errors that nodes of ROS 2 report, in real runs: over Zenoh, and over DDS."""

from __future__ import annotations

import contextlib
import sys

import pytest

from rampart.testing import RealRun, free_port
from tests import ROOT
from tests.actors.ros2.test_gateway import SYSTEM
from tests.actors.ros2.test_live import Peer
from tests.actors.ros2.test_relay import PEER, SETUP, domain, interfaces  # noqa: F401

pytestmark = pytest.mark.processes

REPORTS = """
[[node]]
name = "counter"
actor = "tests.actors.ros2.robot:Asker"
kind = "non-control"
parameters = {{ topic = "count/goal", body = {{}} }}

[[ros2]]
goal = "/count"
type = "{action}"
from = "count/goal"
to = "count/state"

[[ros2]]
subscribe = "/count/_action/status"
type = "action_msgs/msg/GoalStatusArray"
to = "ros/goals"

[[ros2]]
subscribe = "/diagnostics"
type = "diagnostic_msgs/msg/DiagnosticArray"
to = "ros/diagnostics"
publishers = "any"

[[ros2]]
subscribe = "/rosout"
type = "rcl_interfaces/msg/Log"
to = "ros/log"
publishers = "any"

[[detection]]
name = "D_STATUS"
title = "A driver reports an error"
actor = "rampart.actors.ros2.reports:Diagnostics"
within_s = 3.0
parameters = {{ topic = "ros/diagnostics", status = "*", stale_s = 2.0 }}

[[detection]]
name = "D_LOG"
title = "The planner finds no way"
actor = "rampart.actors.ros2.reports:LogMatch"
within_s = 3.0
parameters = {{ topic = "ros/log", logger = "rep*", matches = "no (way|path)", clear_s = 3.0 }}

[[detection]]
name = "D_GOAL"
title = "Goals are aborted"
actor = "rampart.actors.ros2.reports:ActionResult"
within_s = 3.0
parameters = {{ topic = "ros/goals", results = ["aborted"], count = 2, clear_s = 3.0 }}

[[detection]]
name = "D_OWN"
title = "A goal of the system is aborted"
actor = "rampart.actors.ros2.reports:ActionResult"
within_s = 3.0
parameters = {{ topic = "count/state", results = ["aborted"], clear_s = 3.0 }}

[[mechanism]]
name = "M_REPORTS"
detect = "D_STATUS or D_LOG or D_GOAL or D_OWN"
recover = "R_RESTART"
event = "missing"
against = {{ within_s = 20.0, hazard = "the robot stands" }}
"""

BASE = '''[[node]]
name = "base"
actor = "tests.actors.ros2.robot:Base"
kind = "world"

'''
ROUTER = """
[[node]]
name = "router"
actor = "rampart.actors.ros2.router:RosRouter"
kind = "non-control"
parameters = {{ listen = "{endpoint}" }}
"""


@contextlib.contextmanager
def reported(tmp_path, parameters, action, more=""):
    path = tmp_path / "reported.toml"
    head = 'actor = "rampart.actors.ros2.gateway:Gateway"\n'
    path.write_text(SYSTEM.replace(BASE, "").replace(head, f"{head}parameters = {parameters}\n")
                    + REPORTS.format(action=action) + more)
    with RealRun(tmp_path, path) as run:
        yield run


def echo(run, key):
    """Start `rampart topic echo` on a run; its lines come as those of a peer."""
    run.wait_until(lambda: run.pid("gateway"), 30, "the run did not start")
    return Peer("-P", "-m", "rampart.cli.main", "topic", "echo", key, "--json",
                "--port", str(run.port), python=sys.executable)


@contextlib.contextmanager
def over_zenoh(tmp_path):
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with (reported(tmp_path, f'{{ connect = ["{endpoint}"] }}',
                   "nav2_msgs/action/NavigateToPose", ROUTER.format(endpoint=endpoint)) as run,
          Peer(ROOT / "tests/actors/ros2/zenoh_reporter.py", endpoint,
               python=sys.executable) as peer):
        yield run, peer


@contextlib.contextmanager
def over_dds(tmp_path, number):
    interfaces(tmp_path)
    with (reported(tmp_path, f'{{ middleware = "rclpy", setup = "{SETUP}", domain = {number}, '
                             'distribution = "kilted", interfaces = ["interfaces"] }',
                   "test_msgs/action/Fibonacci") as run, Peer(PEER, "reporter") as peer):
        yield run, peer


@pytest.mark.parametrize("wire", ["zenoh", pytest.param("dds", marks=pytest.mark.ros)])
def test_statuses_lines_and_goals_that_other_nodes_report(tmp_path, domain, wire):  # noqa: F811
    over = over_zenoh(tmp_path) if wire == "zenoh" else over_dds(tmp_path, domain)
    with over as (run, peer), echo(run, "detection/*") as reports:
        def until(module, state, reason=""):
            def is_so():
                said = [line["message"] for line in list(reports.lines)
                        if line["source"] == module]
                return bool(said) and said[-1]["state"] == state and reason in said[-1]["reason"]
            run.wait_until(is_so, 40, f"{module} is not {state}: {reason}")

        for module in ("D_STATUS", "D_LOG", "D_GOAL", "D_OWN"):
            until(module, "idle")
        peer.ask("bad")
        until("D_STATUS", "active", "lidar: error: no data")
        peer.ask("well")
        until("D_STATUS", "idle")
        peer.ask("log")
        until("D_LOG", "active", "reporter: no path")
        until("D_LOG", "idle")
        peer.ask("abort")
        until("D_OWN", "active", "aborted")
        until("D_GOAL", "active", "a goal aborted")
        peer.ask("succeed")
        until("D_GOAL", "idle")
        peer.ask("quiet")
        until("D_STATUS", "active", "lidar: no status for 2 s")
        peer.ask("well")
        until("D_STATUS", "idle")
        peer.process.kill()
        until("D_STATUS", "active", "lidar: no status for 2 s")
