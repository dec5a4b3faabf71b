"""`rampart run` and `launch.py`: the same options, each under its own name and with its reports."""

from __future__ import annotations

import shutil
import socket
import subprocess
import sys

import pytest

from rampart.cli import run as launch
from rampart.cli.main import main as rampart
from rampart.testing import free_port
from tests import CELL, ROOT
from tests.whole.checkpoint_runs import write_short_mission


def short(tmp_path):
    return ["--virtual", "--system", "paper", "--mission", str(write_short_mission(tmp_path))]


@pytest.mark.parametrize(("start", "name"), [
    (launch.main, "launch.py"), (lambda told: rampart(["run", *told]), "rampart run")])
def test_messages_and_help_say_what_was_typed(capsys, start, name):
    assert start(["--rate", "99"]) == 2
    assert capsys.readouterr().err == f"{name}: --rate 99: must be between 0.1 and 20\n"
    with pytest.raises(SystemExit) as ended:
        start(["--help"])
    assert ended.value.code == 0
    told = capsys.readouterr().out
    assert told.startswith(f"usage: {name} ")
    assert f"  {name} --mission A --obstacles 2 " in told


def test_a_rate_that_is_none_is_refused_in_one_line(capsys):
    with pytest.raises(SystemExit) as ended:
        launch.main(["--rate", "fast"])
    assert ended.value.code == 2
    assert capsys.readouterr().err.splitlines()[-1].endswith(
        "argument --rate: invalid float value: 'fast'")


def test_a_run_whose_page_would_have_another_program_s_port_is_refused(tmp_path, capsys):
    port = free_port()
    with socket.create_server(("127.0.0.1", port)):
        arguments = ["--hmi-port", str(port), "--report", str(tmp_path / "report")]
        assert launch.main(arguments) == 2
    assert capsys.readouterr().err.startswith(f"launch.py: --hmi-port {port}: ")
    assert not (tmp_path / "report").exists()


def test_a_system_without_an_application_offers_no_options_or_examples_of_a_robot(capsys):
    with pytest.raises(SystemExit):
        launch.main(["--system", str(CELL), "--help"])
    told = capsys.readouterr().out
    assert "--airport" not in told
    assert "osmosis_control" not in told


def test_the_verb_writes_its_report_where_one_is(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert rampart(["run", *short(tmp_path)]) == 0
    page, = (tmp_path / "reports").glob("*-SHORT/inspection-*.html")
    assert "light" in page.read_text("utf-8")


def test_launch_py_writes_its_report_into_its_checkout(tmp_path):
    (tmp_path / "checkout").mkdir()
    shutil.copy(ROOT / "launch.py", tmp_path / "checkout")
    done = subprocess.run(
        [sys.executable, str(tmp_path / "checkout/launch.py"), *short(tmp_path)],
        cwd=tmp_path, capture_output=True, text=True, check=False, timeout=100)
    assert done.returncode == 0, done.stderr
    assert len([*(tmp_path / "checkout/reports").glob("*-SHORT/inspection-*.html")]) == 1
    assert not (tmp_path / "reports").exists()
