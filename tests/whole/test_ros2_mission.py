"""Osmosis with a driver that speaks ROS 2: missions, with deaths on both sides."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from rampart.testing import RealRun, free_port
from tests import ROOT
from tests.whole.checkpoint_runs import write_near_mission
from tests.whole.test_chaos import write_row

SYSTEM = ROOT / "systems/osmosis-ros2.toml"


@pytest.mark.parametrize("faults", [
    ("kill:gateway@6", "kill:osmosis_control@9"),
    pytest.param(("wedge:gateway@6",), marks=pytest.mark.slow)])
def test_a_mission_in_virtual_time_survives_the_gateway(tmp_path, faults):
    planned = [word for fault in faults for word in ("--fault", fault)]
    done = subprocess.run(
        [sys.executable, str(ROOT / "launch.py"), "--system", str(SYSTEM), "--virtual", "--json",
         "--mission", str(write_near_mission(tmp_path)), "--report", str(tmp_path), *planned],
        capture_output=True, text=True, check=False, timeout=120)
    result = json.loads(done.stdout)
    assert (result["mission"], result["safety"]) == ("success", "safe"), done.stderr
    assert all(fault["effective"] for fault in result["faults"])


@pytest.mark.slow
@pytest.mark.processes
@pytest.mark.alone
@pytest.mark.timeout(500)
@pytest.mark.parametrize(("mission", "every_s"), [("row", 3.0), ("AB", 9.0)])
def test_a_mission_on_processes_with_nodes_killed_on_both_sides(tmp_path, mission, every_s):
    where = f"tcp/127.0.0.1:{free_port()}"
    text = SYSTEM.read_text(encoding="utf-8").replace(
        'parameters = { interfaces = ["osmosis-ros2"] }',
        f'parameters = {{ interfaces = ["{SYSTEM.with_suffix("")}"], connect = ["{where}"] }}'
    ).replace("parameters = { upper_laser = true }\nkind = \"world\"",
              f'parameters = {{ upper_laser = true, connect = ["{where}"] }}\nkind = "world"'
              ).replace('name = "ros_router"\n',
                        f'name = "ros_router"\nparameters = {{ listen = "{where}" }}\n')
    (tmp_path / "ros.toml").write_text(text)
    victims = ("gateway", "ros_router", "osmosis_control", "gateway", "localization", "hmi",
               "ros_router", "safety_pilot", "ftm_manager")
    chosen = mission if mission == "AB" else str(write_row(tmp_path))
    with RealRun(tmp_path, tmp_path / "ros.toml", "--mission", chosen,
                 "--record", str(tmp_path / "run.mcap")) as run:
        run.wait_for("goal 1/")
        at_s = 3.0
        for victim in victims:
            run.sleep_until(at_s)
            run.kill(victim)
            at_s += every_s
        code, result = run.result(400)
    assert (result["mission"], result["safety"]) == ("success", "safe"), run.story
    assert code == 0
    assert {"gateway": 2, "ros_router": 2}.items() <= result["restarts"].items()
    done = subprocess.run(
        [sys.executable, "-m", "rampart.cli.main", "bag", "ros2", "run.mcap", "bag", "--json",
         "--system", str(tmp_path / "ros.toml")],
        cwd=tmp_path, capture_output=True, text=True, check=False, timeout=200)
    told = json.loads(done.stdout)
    assert {"/odom", "/imu", "/scan", "/fix", "/cmd_vel", "/rampart/decision",
            "/rampart/localization/pose", "/tf"} <= set(told["messages"]), done.stderr
    assert told["messages"]["/odom"] > 500
