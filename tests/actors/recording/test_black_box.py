"""The black box: the time around a fault is kept, whatever dies, and the robot is undisturbed."""

import contextlib
import json
import os
import re
import signal
import time
from itertools import pairwise
from pathlib import Path

import msgspec
import psutil
import pytest

from rampart.actors.bus.envelope import Header, encode
from rampart.actors.bus.recorder_connection import frame
from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.recording import incidents, ring
from rampart.actors.recording.bag_reader import BagReader, Summary
from rampart.actors.recording.bag_writer import BagError
from rampart.actors.recording.black_box import BlackBoxWriter
from rampart.actors.recording.incidents import incidents_in
from rampart.actors.recording.process import Order, RecorderProcess
from rampart.actors.recording.run_documents import SYSTEM
from rampart.actors.runtime.run_plan import RunPlan
from rampart.actors.supervision.process_title import find_processes
from rampart.cli.main import main
from rampart.cli.record.incident_verbs import names
from rampart.cli.run import _black_box, black_box_folder
from rampart.cli.run_options import parse
from rampart.manager.spec.tables import BlackBox as Limits
from rampart.testing import RealRun, wait_until
from tests import ROOT
from tests.actors.recording.samples import AnsweringLauncher, documents, pid_of, pose
from tests.osmosis_system import shipped_system

LIMITS = Limits(before_s=20, after_s=5)


def decision(number, at_s, active=("FTM6",)):
    record = fm.DecisionRecord(number, "safety-first", active, 1, ("RM4",), ("FTM6",), (), at_s)
    return at_s, ftm_topics.DECISION.at(), encode(Header("ftm_manager", 1, number, at_s), record)


def crash(at_s, node="localization"):
    event = fm.ProcessEvent(node, "crashed", 7, 1, "", "")
    return at_s, ftm_topics.PROCESS_EVENT.at(), encode(Header("supervisor", 1, 1, at_s), event)


class Box:
    """A black box that is handed a second of messages at a time."""

    def __init__(self, folder, limits=LIMITS, *, run="sample", again=False):
        self.folder = folder / "paper"
        self.now = 1_800_000_000.0
        self.sent = 0
        described = documents(run_id=run)
        table = f"\n[black_box]\nbefore_s = {limits.before_s}\n".encode()
        described = msgspec.structs.replace(described, files=tuple(
            (name, media, data + (table if name == SYSTEM else b""))
            for name, media, data in described.files))
        self.writer = BlackBoxWriter(self.folder, described, limits, again=again,
                                     wall=lambda: self.now)

    def take(self, *message):
        self.writer.write([frame(*message)])

    def second(self, at_s, *messages, poses=20):
        self.now += 1
        for i in range(poses):
            self.sent += 1
            self.take(*pose(self.sent, at_s + i / poses))
        for message in messages:
            self.take(*message)
        self.writer.flush()

    def seconds(self, from_s, to_s):
        for at_s in range(from_s, to_s):
            self.second(float(at_s))

    @property
    def kept(self):
        """The incidents that are over, as a tool lists them, each with a recording."""
        incidents.settle(self.folder)
        found = []
        for incident, path in incidents_in(self.folder):
            if incidents.is_over(path.parent, incident):
                out = self.folder.parent / path.name
                found.append((incidents.write_recording(path.parent, incident, out), out))
        return found


@pytest.fixture
def box(tmp_path):
    made = Box(tmp_path)
    yield made
    made.writer.abandon()


def times(path):
    return sorted(m.log_time / 1e9 for _, m in BagReader(path).messages())


def size(folder):
    return sum(path.stat().st_size for path in folder.glob("*/*"))


def test_a_decision_keeps_the_time_before_and_after_it_in_a_recording(box):
    box.seconds(0, 100)
    box.second(100.0, decision(1, 100.5))
    box.seconds(101, 140)
    (box.folder / "sample" / "20200101-000000-000.json").write_text('{"name": 1}')  # damaged
    [(incident, path)] = box.kept
    assert (incident.at_s, incident.run, incident.system) == (100.5, "sample", "paper")
    assert "FTM6" in incident.cause
    assert incident.partial == ""
    assert times(path)[0] == pytest.approx(80.5, abs=0.1)
    assert times(path)[-1] == pytest.approx(105.5, abs=0.1)
    summary = Summary(BagReader(path))
    assert summary.reader.closed
    assert summary.end["cause"] == incident.cause
    assert summary.run["mission"] == "AB"
    assert summary.run["rampart_version"]
    assert {"system.toml", "airport/vallombre.toml"} <= {name for name, _, _ in summary.files}
    assert summary.counts.total() > 500


def test_a_healthy_run_the_end_of_a_fault_and_garbage_on_watched_keys_leave_nothing(box):
    for number in range(100):
        box.take(0.5, ftm_topics.DECISION.at(), b"\xc1 garbage")
        box.take(0.5, ftm_topics.DETECTION.at(f"DM{number}"), b"")
    box.writer.write([b"short"])
    box.seconds(0, 20)
    box.second(20.0, decision(1, 20.5, active=()))
    box.seconds(21, 60)
    box.writer.end()
    assert incidents_in(box.folder) == []
    assert not list(box.folder.glob("*/"))


def test_overlapping_incidents_are_one_file(box):
    box.seconds(0, 30)
    box.second(30.0, decision(1, 30.0))
    box.seconds(31, 50)
    box.second(50.0, decision(2, 50.0))  # its time before reaches into the first one
    box.seconds(51, 90)
    [(incident, path)] = box.kept
    assert (incident.at_s, times(path)[-1]) == (30.0, pytest.approx(55.0, abs=0.1))
    box.seconds(90, 100)
    box.second(100.0, decision(3, 100.0))
    box.seconds(101, 140)
    assert [i.at_s for i, _ in box.kept] == [30.0, 100.0]


def test_decisions_in_a_row_are_bounded_in_length_and_size(tmp_path):
    box = Box(tmp_path, Limits(before_s=20, after_s=5, limit_mb=1))
    most = 0
    for at_s in range(0, 1000, 5):
        box.second(float(at_s), decision(at_s + 1, at_s + 0.5), poses=200)
        most = max(most, size(box.folder))
    box.writer.end()
    spans = [(i.from_s, i.to_s) for i, _ in incidents_in(box.folder)]
    assert 3 <= len(spans) < 30
    assert all(to_s - from_s <= 36 for from_s, to_s in spans)
    assert all(b[0] - a[1] < 1.0 for a, b in pairwise(spans))  # no gap
    assert max(most, size(box.folder)) < 1.3e6  # the limit, and what one turn adds


def test_a_limit_below_the_size_of_an_incident_keeps_its_newest_part(tmp_path):
    box = Box(tmp_path, Limits(before_s=600, after_s=5, limit_mb=0.1))
    for at_s in range(0, 400, 10):
        box.second(float(at_s), poses=150)
        assert size(box.folder) < 0.15e6
    box.second(400.0, decision(1, 400.0))
    box.seconds(401, 405)
    [(incident, path)] = incidents_in(box.folder)
    done = incidents.write_recording(path.parent, incident, tmp_path / "part.mcap")
    assert "began later" in done.partial
    assert times(tmp_path / "part.mcap")[-1] > 404
    box.writer.abandon()


def test_after_a_kill_of_everything_the_last_second_is_readable(tmp_path):
    box = Box(tmp_path)
    box.seconds(0, 50)
    box.second(50.0, decision(1, 50.5))
    box.second(51.0)
    box.take(*pose(999, 52.0))  # was not synced
    box.writer.abandon()  # the kernel closes files and lock of a killed process
    incidents.settle(box.folder)
    [(incident, path)] = box.kept
    assert times(path)[-1] == pytest.approx(51.95, abs=0.01)
    assert incident.partial == "the run was cut off"
    incidents.settle(box.folder)  # twice is once
    assert len(box.kept) == 1


def test_an_incident_that_the_death_of_the_launcher_cuts_off_is_marked(box):
    box.second(30.0, decision(1, 30.5))
    box.writer.end(is_cut_off=True)
    assert [(i.at_s, i.partial) for i, _ in box.kept] == [(30.5, "the run was cut off")]


def test_a_run_that_is_cut_off_without_a_fault_leaves_its_last_seconds(tmp_path):
    box = Box(tmp_path, Limits())
    box.seconds(0, 100)
    box.writer.abandon()
    incidents.settle(box.folder)
    [(incident, path)] = box.kept
    assert incident.cause == "the run was cut off"
    assert (times(path)[0], times(path)[-1]) == (
        pytest.approx(39.95, abs=0.1), pytest.approx(99.95, abs=0.1))


@pytest.mark.parametrize("cut", [1, 20, 300])
def test_a_torn_or_damaged_block_costs_only_itself(tmp_path, cut):
    box = Box(tmp_path)
    box.seconds(0, 9)
    box.writer.abandon()
    [segment] = ring.segments(box.folder / "sample")
    data = segment.read_bytes()
    segment.write_bytes(data[:-cut])
    read = [at_s for at_s, _, _ in ring.read(segment.parent, -1e9, 1e9)]
    assert read == [i / 20 for i in range(160)]
    segment.write_bytes(bytes([*data[:100], data[100] ^ 255, *data[101:]]))
    assert len(list(ring.read(segment.parent, -1e9, 1e9))) == 160


def test_a_restarted_black_box_continues_the_incident(tmp_path):
    box = Box(tmp_path)
    box.seconds(0, 30)
    box.second(30.0, decision(1, 30.5))
    box.writer.abandon()
    after = Box(tmp_path, again=True)
    after.sent = box.sent + 40  # two seconds were lost
    after.seconds(33, 70)
    [(incident, path)] = after.kept
    assert (incident.at_s, incident.to_s) == (30.5, pytest.approx(35.5, abs=0.1))
    summary = Summary(BagReader(path))
    assert summary.end["lost"] == '{"localization": 40}'
    assert times(path)[0] == pytest.approx(10.5, abs=0.1)
    after.writer.abandon()


def test_two_runs_at_a_time_keep_their_incidents_apart(tmp_path, monkeypatch):
    one, other = Box(tmp_path), Box(tmp_path, run="other")
    one.second(0.0, decision(1, 0.5))
    other.second(0.0, crash(0.5))
    incidents.settle(one.folder)  # both live: their rings stay
    assert ring.segments(one.folder / "sample")
    assert ring.segments(one.folder / "other")
    one.seconds(1, 30)
    other.seconds(1, 30)
    assert sorted(i.run for i, _ in one.kept) == ["other", "sample"]
    monkeypatch.setattr("rampart.actors.recording.black_box._LOCK_S", 0.2)
    with pytest.raises(BagError, match="another black box"):
        Box(tmp_path, run="other", again=True)
    one.writer.end()
    other.writer.end()


def test_the_reserve_of_the_disk_costs_the_oldest_first_then_ends_with_one_line(
        tmp_path, monkeypatch):
    box = Box(tmp_path)
    for start in (0, 100):
        box.second(float(start), decision(start + 1, start + 0.5))
        box.seconds(start + 1, start + 40)
    assert len(box.kept) == 2
    newest = box.kept[1][0].name
    full_below = size(box.folder) - 1000

    def check(_file):
        if size(box.folder) > full_below:
            raise OSError(28, "less than 256 MB are free on its disk")

    monkeypatch.setattr("rampart.actors.recording.black_box.check_reserve", check)
    box.second(140.0)
    assert [i.name for i, _ in box.kept] == [newest]
    full_below = 0
    with pytest.raises(OSError, match="less than 256 MB"):
        box.second(141.0)
    assert [i.name for i, _ in incidents_in(box.folder)] == [newest]  # it may still be extended
    box.writer.abandon()


# -- the process ----------------------------------------------------------------------------


def boxes():
    """Return the pids of this process's black boxes, also of those that are still starting."""
    found = []
    for child in psutil.Process().children():
        with contextlib.suppress(psutil.Error):  # it has just ended
            if "rampart.actors.recording.process" in child.cmdline():
                found.append(child.pid)
    return found


def test_a_killed_black_box_is_started_again_to_continue_its_ring(
        launcher, port, tmp_path, monkeypatch):
    monkeypatch.setattr("rampart.actors.recording.process._AGAIN_S", 0.0)
    box = RecorderProcess(Order(port, str(tmp_path / "paper"), launcher.pid, black_box=LIMITS))
    box.start()
    [killed] = boxes()
    os.kill(killed, signal.SIGKILL)
    wait_until(lambda: box.keep_alive() == "" and boxes() not in ([], [killed]))
    [back] = boxes()
    order = Path(f"/proc/{back}/cmdline").read_bytes().split(b"\0")[-2]
    assert msgspec.json.decode(order, type=Order).again
    os.kill(back, signal.SIGTERM)  # before it has a handler
    box.end()


def test_a_folder_that_cannot_be_made_ends_it_with_one_line(launcher, port, tmp_path):
    (tmp_path / "file").write_text("")
    folder = str(tmp_path / "file" / "paper")
    box = RecorderProcess(Order(port, folder, launcher.pid, black_box=LIMITS))
    with AnsweringLauncher(port, time.monotonic(), launcher.pid):
        box.start()
        wait_until(box.keep_alive, 30, "it does not end")
    assert re.fullmatch(r"[^\n]*Not a directory[^\n]*", box.keep_alive())
    box.end()


# -- rampart incident: what a user sees of incidents, also after everything was killed --


CELL = ROOT / "tests" / "systems" / "cell.toml"


@pytest.fixture
def home(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    return tmp_path / "rampart"


@pytest.fixture
def held(home):
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


def test_the_list_has_finished_incidents_and_those_that_are_not_over(held, capsys):
    text = printed(capsys, "list")
    assert "localization crashed, incarnation 1" in text
    assert "not over yet" in text
    found = json.loads(printed(capsys, "list", "--json"))["incidents"]
    assert [(row["at_s"], row["partial"]) for row in found] == [
        (30.5, ""), (100.5, "not over yet")]
    assert names() == [row["name"] for row in found]


def test_the_story_has_cause_certificate_and_what_each_node_did(held, capsys):
    [first, second] = names()
    text = printed(capsys, "show", first)
    assert "certificate of decision 1: rule 1 of safety-first" in text
    assert "[   30.50 s] decision 1" in text
    story = json.loads(printed(capsys, "show", first, "--json"))
    assert story["nodes"]["localization"]["messages"] > 400
    assert story["decisions"][0]["path"] == ["FTM6"]
    assert "localization crashed" in printed(capsys, "show")  # the newest, so far
    assert second > first


def test_an_export_is_a_recording_with_all_that_a_replay_needs(held, capsys, tmp_path, monkeypatch):
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


def test_an_incident_is_played_back(held, capsys):
    first = names()[0]
    assert "played" in printed(capsys, "replay", first, "--rate", "200", "--port", "7391")


@pytest.mark.parametrize(("arguments", "words"), [
    (["show", "nothing"], "nothing: no such incident"),
    (["show", "2027"], "2027: 2 incidents begin so")])
@pytest.mark.usefixtures("held")
def test_an_unknown_name_is_refused_in_one_line(refused, arguments, words):
    assert words in refused("incident", *arguments)


def test_without_incidents_the_verbs_are_clear(home, capsys):
    assert "no incidents in" in printed(capsys, "list")
    assert "no faults in" in printed(capsys, "history")
    assert main(["incident", "show"]) == 2
    assert "no incidents in" in capsys.readouterr().err


def test_the_history_is_listed_and_cleared(held, capsys):
    held.writer.end()
    text = printed(capsys, "history")
    assert "supervisor" in text
    assert "crashed" in text
    assert main(["incidents", "--json"]) == 0
    [fault] = json.loads(capsys.readouterr().out)["faults"]
    assert (fault["system"], fault["state"], fault["times"]) == ("paper", "confirmed", 1)
    assert "paper: 0 faults cleared" in printed(capsys, "history", "--clear")


def test_incidents_of_a_folder_that_cannot_be_written_are_still_readable(held, capsys, monkeypatch):
    held.writer.abandon()

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
