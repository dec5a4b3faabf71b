"""`rampart incident`: what a user sees of incidents, also after everything was killed."""

import json
import os
import signal
import time

import pytest

from rampart.actors.recording.bag_reader import BagReader, Summary
from rampart.actors.runtime.run_plan import RunPlan
from rampart.actors.supervision.process_title import find_processes
from rampart.cli.main import main
from rampart.cli.record.incident_verbs import names
from rampart.cli.run import _black_box, black_box_folder
from rampart.cli.run_options import parse
from rampart.testing import RealRun, wait_until
from tests import ROOT
from tests.actors.recording.samples import pid_of
from tests.actors.recording.test_black_box import Box, crash, decision
from tests.osmosis_system import shipped_system

CELL = ROOT / "tests" / "systems" / "cell.toml"


@pytest.fixture
def home(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    return tmp_path / "rampart"


@pytest.fixture
def box(home):
    made = Box(home)
    made.seconds(0, 30)
    made.second(30.0, decision(1, 30.5))
    made.seconds(31, 60)
    made.second(100.0, crash(100.5))
    yield made
    made.writer.abandon()


def printed(capsys, *arguments):
    assert main(["incident", *arguments]) == 0
    return capsys.readouterr().out


def test_the_list_has_finished_incidents_and_those_that_are_not_over(box, capsys):
    text = printed(capsys, "list")
    assert "localization crashed, incarnation 1" in text
    assert "not over yet" in text
    found = json.loads(printed(capsys, "list", "--json"))["incidents"]
    assert [(row["at_s"], row["partial"]) for row in found] == [
        (30.5, ""), (100.5, "not over yet")]
    assert names() == [row["name"] for row in found]


def test_the_story_has_cause_certificate_and_what_each_node_did(box, capsys):
    [first, second] = names()
    text = printed(capsys, "show", first)
    assert "certificate of decision 1: rule 1 of safety-first" in text
    assert "[   30.50 s] decision 1" in text
    story = json.loads(printed(capsys, "show", first, "--json"))
    assert story["nodes"]["localization"]["messages"] > 400
    assert story["decisions"][0]["path"] == ["FTM6"]
    assert "localization crashed" in printed(capsys, "show")  # the newest, so far
    assert second > first


def test_an_export_is_a_recording_with_all_that_a_replay_needs(box, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    [first, second] = names()
    printed(capsys, "export", first, "out.mcap")
    assert main(["bag", "info", "out.mcap"]) == 0
    assert "attached   system.toml" in capsys.readouterr().out
    assert main(["incident", "export", first, "out.mcap"]) == 2
    assert "exists already" in capsys.readouterr().err
    printed(capsys, "export", second, "out.mcap", "--overwrite")
    printed(capsys, "export", second)
    assert (tmp_path / f"incident-{second}.mcap").exists()


def test_an_incident_is_played_back(box, capsys):
    first = names()[0]
    assert "played" in printed(capsys, "replay", first, "--rate", "200", "--port", "7391")


@pytest.mark.parametrize(("arguments", "words"), [
    (["show", "nothing"], "nothing: no such incident"),
    (["show", "2027"], "2027: 2 incidents begin so")])
@pytest.mark.usefixtures("box")
def test_an_unknown_name_is_refused_in_one_line(refused, arguments, words):
    assert words in refused("incident", *arguments)


def test_without_incidents_the_verbs_are_clear(home, capsys):
    assert "no incidents in" in printed(capsys, "list")
    assert "no faults in" in printed(capsys, "history")
    assert main(["incident", "show"]) == 2
    assert "no incidents in" in capsys.readouterr().err


def test_the_history_is_listed_and_cleared(box, capsys):
    box.writer.end()
    text = printed(capsys, "history")
    assert "supervisor" in text
    assert "crashed" in text
    assert main(["incidents", "--json"]) == 0
    [fault] = json.loads(capsys.readouterr().out)["faults"]
    assert (fault["system"], fault["state"], fault["times"]) == ("paper", "confirmed", 1)
    assert "paper: 0 faults cleared" in printed(capsys, "history", "--clear")


def test_incidents_of_a_folder_that_cannot_be_written_are_still_readable(box, capsys, monkeypatch):
    box.writer.abandon()

    def refused(*_args, **_fields):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("rampart.actors.recording.incidents.describe", refused)
    assert "localization crashed" in printed(capsys, "show")


# -- real runs ------------------------------------------------------------------------------


@pytest.mark.processes
@pytest.mark.alone
def test_after_a_kill_of_a_whole_run_its_incident_is_read_to_the_last_second(
        home, tmp_path, capsys):
    beside = tmp_path / "beside.mcap"  # a recording of the same run
    with RealRun(tmp_path, "osmosis", "--mission", "A", "--black-box", "--record", beside) as run:
        run.sleep_until(3.0)
        run.kill("localization")
        run.sleep_until(7.0)
        box = pid_of("black-box", run.port)
        killed_s = (time.monotonic() - run.info.origin_s) * run.info.rate
        os.kill(box, signal.SIGKILL)
        os.kill(run.info.pid, signal.SIGKILL)
        wait_until(lambda: not find_processes(run.port), 10, "processes are left")
    found = json.loads(printed(capsys, "list", "--json"))["incidents"]
    incident = max(found, key=lambda row: row["to_s"])  # on a busy machine another cause is first
    assert incident["to_s"] > killed_s - 3.0  # sync, turn, and a busy machine
    printed(capsys, "export", incident["name"], str(tmp_path / "kept.mcap"))
    summary = Summary(BagReader(tmp_path / "kept.mcap"))
    assert "DM7" in {name.partition("/")[2] for name in (
        channel.topic for channel in summary.reader.channels.values())}
    assert "respawned by RM4" in printed(capsys, "show")
    assert {"rampart/supervisor/event", "rampart/localization/pose"} <= set(
        Summary(BagReader(beside)).keys)


@pytest.mark.parametrize(("arguments", "has_one"), [
    ([], True), (["--black-box"], True), (["--no-black-box"], False), (["--virtual"], False)])
def test_a_real_run_on_one_machine_has_one(home, arguments, has_one):
    options, _ = parse(["--system", str(CELL), *arguments], "launch.py")
    folder = str(home / "paper") if has_one else ""
    assert black_box_folder(options, shipped_system()) == folder


def test_a_user_without_a_home_directory_has_a_run_and_one_line(monkeypatch, capsys):
    monkeypatch.delenv("XDG_STATE_HOME")
    monkeypatch.delenv("HOME")
    monkeypatch.setattr("os.getuid", lambda: 4_000_000)  # as in a container
    options, _ = parse(["--system", str(CELL)], "launch.py")
    assert black_box_folder(options, shipped_system()) == ""
    assert capsys.readouterr().err.endswith(
        ": black box: this user has no home directory; expected a folder in XDG_STATE_HOME\n")
    assert main(["incident", "list"]) == 2


def test_a_black_box_that_cannot_start_is_one_line(monkeypatch):
    lines = []

    def refused(_self):
        raise OSError(11, "Resource temporarily unavailable")

    monkeypatch.setattr("rampart.actors.recording.process.RecorderProcess.start", refused)
    plan = RunPlan(black_box="/nowhere")
    with _black_box(plan, shipped_system(), lines.append) as keep_alive:
        keep_alive()
    assert lines == ["black box: cannot start: Resource temporarily unavailable"]
