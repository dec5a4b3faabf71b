"""Osmosis with a driver that speaks ROS 2: missions, with deaths on both sides."""

from __future__ import annotations

import json

import pytest

from rampart.cli.main import main
from rampart.testing import RealRun, free_port
from tests import ROOT
from tests.whole.missions import write_mission

SYSTEM = ROOT / "systems/osmosis-ros2.toml"


def test_a_mission_in_virtual_time_survives_the_gateway(tmp_path, capsys):
    assert main(["run", "--system", str(SYSTEM), "--virtual", "--json", "--report", str(tmp_path),
                 "--mission", str(write_mission(tmp_path, "NEAR")), "--fault", "kill:gateway@6",
                 "--fault", "kill:osmosis_control@9"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert (result["mission"], result["safety"]) == ("success", "safe")
    assert all(fault["effective"] for fault in result["faults"])


@pytest.mark.slow
@pytest.mark.processes
@pytest.mark.alone
@pytest.mark.timeout(500)
def test_a_mission_on_processes_with_nodes_killed_on_both_sides(tmp_path):
    where = f"tcp/127.0.0.1:{free_port()}"
    text = SYSTEM.read_text(encoding="utf-8")
    for old, new in (
            ('interfaces = ["osmosis-ros2"]',
             f'interfaces = ["{SYSTEM.with_suffix("")}"], connect = ["{where}"]'),
            ("upper_laser = true", f'upper_laser = true, connect = ["{where}"]'),
            ('name = "ros_router"\n',
             f'name = "ros_router"\nparameters = {{ listen = "{where}" }}\n')):
        assert text.count(old) == 1
        text = text.replace(old, new)
    (tmp_path / "ros.toml").write_text(text)
    victims = ("gateway", "ros_router", "osmosis_control", "gateway", "localization", "hmi",
               "ros_router", "safety_pilot", "ftm_manager")
    with RealRun(tmp_path, tmp_path / "ros.toml", "--mission",
                 str(write_mission(tmp_path, "ROW"))) as run:
        run.wait_for("goal 1/")
        for number, victim in enumerate(victims, 1):
            run.sleep_until(3.0 * number)
            run.kill(victim)
        code, result = run.result(400)
    assert (result["mission"], result["safety"]) == ("success", "safe"), run.story
    assert code == 0
    assert {"gateway": 2, "ros_router": 2}.items() <= result["restarts"].items()
