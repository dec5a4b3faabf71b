"""What a user meets on the first day: ports, names that are none, faults by name, exit codes."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from rampart.cli import output
from rampart.cli.main import main
from rampart.testing import RealRun
from tests import CELL, TANK

NO_RUN = "rampart: --port 31999: no run there; runs found: "


@pytest.mark.parametrize("arguments", [
    "adapt --port=31999 --json set strategy guarded-repair",
    "adapt set strategy guarded-repair --port 31999", "node --json --port 31999 list",
    "topic hz no/such --port 31999", "inject kill:nobody --port 31999"])
def test_the_port_may_stand_anywhere_and_no_run_is_said_before_anything_else(refused, arguments):
    assert refused(*arguments.split()).startswith(NO_RUN)


def test_the_environment_names_the_run(refused, monkeypatch):
    monkeypatch.setenv("RAMPART_PORT", "31999")
    assert refused("status").startswith(NO_RUN)
    assert refused("status", "--port", "31998").startswith("rampart: --port 31998: ")
    monkeypatch.setenv("RAMPART_PORT", "74x0")
    assert "RAMPART_PORT=74x0: expected a whole number" in refused("status")


def test_a_name_among_many_is_answered_by_the_nearest_three(refused):
    told = refused("topic", "info", "control/comand", "--system", "osmosis")
    assert told.startswith("rampart: unknown topic 'control/comand'; the nearest of ")
    assert told.endswith(": control/command, control/standby_command, control/status\n")
    assert str(output.unknown("topic", "?", map(str, range(20)))) == (
        "unknown topic '?'; none of 20 is similar")
    assert str(output.unknown("order", "x", ["a", "b"])) == "unknown order 'x'; known: a, b"


def test_every_object_says_its_format(capsys):
    for arguments in (("check", str(CELL)), ("explain", str(CELL)), (
            "decide", "M_CURTAIN", "--system", str(CELL)), (
            "topic", "info", "manager/status", "--system", str(CELL))):
        assert main([*arguments, "--json"]) == 0
        assert next(iter(json.loads(capsys.readouterr().out).items())) == ("format", 1)


SYSTEM = """
[[node]]
name = "gauge"
actor = "first_day_parts:Gauge"
kind = "control"

[[node]]
name = "sick"
actor = "first_day_parts:Sick"
kind = "control"
"""
PARTS = """
from rampart import Actor, Message, Qos, Topic, every

class Level(Message):
    level_m: float

LEVEL = Topic("tank/level", Level, Qos.SENSOR, 10, "", "Level.")

class Gauge(Actor):
    outputs = (LEVEL,)

    @every(0.1)
    def say(self) -> None:
        self.publish(LEVEL, Level(1.5))

class Sick(Actor):
    def on_start(self) -> None:
        raise RuntimeError("no sensor")
"""


@pytest.mark.processes
@pytest.mark.alone
def test_a_real_run_with_a_node_that_never_comes_up_ends_with_1_and_names_it(tmp_path):
    head = TANK.split("[[node]]")[0]
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "first_day_parts.py").write_text(PARTS)
    (tmp_path / "run" / "day.toml").write_text(
        head + '[layers]\nftm = false\n[orders.safer]\n[[event]]\nname = "e"\n' + SYSTEM)
    with RealRun(tmp_path / "run", "day.toml", "--duration", "6") as day:
        day.sleep_until(1)
        (tmp_path / "run" / "first_day_parts.py").unlink()
        elsewhere = subprocess.run(
            [sys.executable, "-P", "-m", "rampart.cli.main", "topic", "echo", "tank/level", "-n",
             "1", "--port", str(day.port)], cwd=tmp_path, capture_output=True, text=True,
            check=False, timeout=30)
        killed = day.tool("inject", "kill:gauge", "--json")
        code, result = day.result()
    assert elsewhere.returncode == 0, elsewhere.stderr
    assert "No module named 'first_day_parts'" in elsewhere.stderr
    assert elsewhere.stderr.endswith("; messages are shown as they describe themselves\n")
    assert elsewhere.stdout.endswith(' gauge#1 tank/level {"level_m":1.5}\n'.replace("gauge#1", (
        elsewhere.stdout.split()[1])))
    told = json.loads(killed.stdout)
    assert (told["format"], told["fault"], told["node"], told["effective"]) == (
        1, "kill:gauge", "gauge", True)
    assert result["restarts"]["gauge"] == 1
    assert (code, result["format"], result["failing"]) == (1, 1, ["sick"])
    assert "sick fails again and again; it was restarted " in day.story
