"""What a user meets on the first day: ports, names that are none, faults by name, exit codes."""

import json

import pytest

from rampart.cli.main import main
from rampart.cli.operate import kill_node
from rampart.testing import RealRun
from tests import CELL, TANK

NO_RUN = "rampart: --port 31999: no run there; runs found: "


@pytest.mark.parametrize("arguments", [
    "adapt set strategy guarded-repair --port 31999", "node list --json --port 31999",
    "topic echo no/such --port 31999", "inject drop:no/such --port 31999"])
def test_that_there_is_no_run_is_said_before_anything_else(refused, arguments):
    assert refused(*arguments.split()).startswith(NO_RUN)


def test_the_environment_names_the_run(refused, monkeypatch):
    monkeypatch.setenv("RAMPART_PORT", "31999")
    assert refused("status").startswith(NO_RUN)
    assert refused("status", "--port", "31998").startswith("rampart: --port 31998: ")
    monkeypatch.setenv("RAMPART_PORT", "74x0")
    assert "RAMPART_PORT=74x0: expected a whole number" in refused("status")


def test_every_object_says_its_format(capsys):
    for arguments in (("check", str(CELL)), ("explain", str(CELL)), (
            "decide", "M_CURTAIN", "--system", str(CELL)), (
            "topic", "info", "manager/status", "--system", str(CELL))):
        assert main([*arguments, "--json"]) == 0
        assert next(iter(json.loads(capsys.readouterr().out).items())) == ("format", 1)


SICK = """
from rampart import Actor

class Sick(Actor):
    def on_start(self) -> None:
        raise RuntimeError("no sensor")
"""


@pytest.mark.processes
@pytest.mark.alone
def test_a_real_run_with_a_node_that_never_comes_up_ends_with_1_and_names_it(
        tmp_path, capsys):
    (tmp_path / "first_day_parts.py").write_text(SICK)
    nodes = "".join(f'[[node]]\nname = "{name}"\nactor = "{actor}"\nkind = "control"\n'
                    for name, actor in (("gauge", "rampart.actors.runtime.stub_node:StubNode"),
                                        ("sick", "first_day_parts:Sick")))
    (tmp_path / "day.toml").write_text(
        TANK.split("[[node]]")[0] + '[layers]\nftm = false\n[orders.safer]\n[[event]]\n'
        'name = "e"\n' + nodes)
    with RealRun(tmp_path, "day.toml", "--duration", "6") as day:
        day.sleep_until(1)
        assert kill_node.main(["gauge", "--json", "--port", str(day.port)]) == 0
        code, result = day.result()
    killed = json.loads(capsys.readouterr().out)
    assert (killed["node"], killed["signal"], killed["incarnation"]) == ("gauge", "KILL", 1)
    assert result["restarts"]["gauge"] == 1
    assert (code, result["format"], result["failing"]) == (1, 1, ["sick"])
    assert "sick fails again and again; it was restarted " in day.story
