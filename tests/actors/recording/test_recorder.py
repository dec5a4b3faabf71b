"""The recorder process: it loses nothing, waits for nobody, and nobody waits for it."""

from __future__ import annotations

import errno
import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import msgspec
import pytest
import zenoh
from mcap.exceptions import EndOfFile
from mcap.reader import make_reader
from mcap.records import Message
from mcap.stream_reader import StreamReader

from rampart.actors.bus import recorder_connection as wire
from rampart.actors.bus import run_folder
from rampart.actors.bus.envelope import Header, encode
from rampart.actors.bus.messages import Heartbeat
from rampart.actors.bus.recorder_connection import RecorderConnection, frame, parse_frame
from rampart.actors.bus.topics import HEARTBEAT
from rampart.actors.bus.zenoh_session import endpoint, session_config
from rampart.actors.osmosis import topics
from rampart.actors.recording.bag_reader import BagReader, Summary, key_of
from rampart.actors.recording.bag_writer import BagError, BagWriter
from rampart.actors.recording.message_form import Forms, header_of
from rampart.actors.recording.process import Order, RecorderProcess, result_of
from rampart.actors.recording.recorder import Recorder
from rampart.actors.recording.run_listener import FLUSH_S, PERIOD_S
from rampart.cli.main import main
from rampart.testing import HEEDS_SIGNALS, RealRun, wait_until
from tests import ROOT
from tests.actors.recording.samples import AnsweringLauncher, documents, pid_of, pose, running


def numbers(path):
    """The numbers of the messages that are in a file so far."""
    if not path.exists() or not path.stat().st_size:
        return []
    return [header_of(Forms(topics.ALL).of(key).payload(message.data)).sequence
            for channel, message in BagReader(path).messages() if (key := key_of(channel))]


@pytest.fixture
def dead():
    """The number of a process that has ended."""
    process = subprocess.Popen(["true"])
    process.wait()
    return process.pid


class Robot:
    """One node that sends poses, numbered."""

    def __init__(self, port):
        self.connection = RecorderConnection(port)
        self.sent = 0
        self.begun_s = time.monotonic()

    def send(self, count=1):
        for _ in range(count):
            self.sent += 1
            _, key, payload = pose(self.sent, time.monotonic() - self.begun_s)
            self.connection.take(key, payload)


@pytest.fixture
def recording(port, launcher, tmp_path):
    """A recorder process, the launcher that it belongs to, and a robot of one node."""
    path = tmp_path / "run.mcap"
    with AnsweringLauncher(port, time.monotonic() + 100.5, launcher.pid):
        process = RecorderProcess(Order(port, str(path), launcher.pid))
        process.start()
        robot = Robot(port)
        yield process, robot, path
        process.end()
        robot.connection.close()


def test_everything_is_written_from_the_first_message_to_the_last(
        recording, port, launcher, tmp_path):
    process, robot, path = recording
    second = RecorderProcess(Order(port, str(tmp_path / "second.mcap"), launcher.pid))
    with pytest.raises(BagError, match=f"port {port} is being recorded already"):
        second.start()
    robot.send(500)
    wait_until(lambda: numbers(path), 15, "nothing is written")
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as stranger:
        stranger.connect(wire.address(port))
        for junk in (b"x", b"\xff" * 100, frame(float("nan"), "k", b"")[:-1]):
            stranger.send(junk)
        robot.connection.take("rampart/manager/system", b"x" * (wire.MAX_FRAME_BYTES + 1))
        robot.send(500)
    killed = (
        "import os\n"
        "from tests.actors.recording.test_recorder import Robot\n"
        f"robot = Robot({port}); robot.sent = 1000\n"
        "robot.send(300); os.kill(os.getpid(), 9)\n")
    subprocess.run([sys.executable, "-c", killed], cwd=ROOT, check=False)
    process.end()
    assert numbers(path) == list(range(1, 1301))
    summary = Summary(BagReader(path))
    assert (summary.reader.closed, summary.end["lost"]) == (True, "{}")
    assert summary.end["ended"] == "the run has ended"
    assert -102 < summary.time_zero_s < -50  # it was there before simulated time 0
    assert summary.first_ns < 1e9


def test_a_killed_recorder_leaves_a_readable_file_that_lacks_the_last_second_at_most(
        recording, port):
    _, robot, path = recording
    while not numbers(path):
        robot.send()
        time.sleep(0.02)
    lost_s = FLUSH_S + PERIOD_S + 2 * FLUSH_S  # the last is for a busy machine
    sent_s = [time.monotonic()] * robot.sent
    while sent_s[-1] - sent_s[0] < lost_s + 1.0:  # it writes while it is being talked to
        robot.send()  # not so many that they would fill a chunk, which is written when it is full
        sent_s.append(time.monotonic())
        time.sleep(0.02)
    pid, killed_s = pid_of("recorder", port), time.monotonic()
    os.kill(pid, signal.SIGKILL)
    kept = numbers(path)
    assert kept == list(range(1, len(kept) + 1))
    assert len(kept) >= sum(at_s < killed_s - lost_s for at_s in sent_s) > 0
    assert not BagReader(path).closed
    found = []
    with path.open("rb") as file, pytest.raises(EndOfFile):  # the independent reader
        found.extend(StreamReader(file).records)
    assert sum(isinstance(record, Message) for record in found) >= len(kept)
    assert main(["bag", "info", str(path)]) == 0


def test_a_stopped_recorder_holds_nobody_up_and_what_did_not_fit_is_counted(recording, port):
    process, robot, path = recording
    robot.send(10)
    wait_until(lambda: len(numbers(path)) == 10, 15, "nothing is written")
    pid = pid_of("recorder", port)
    os.kill(pid, signal.SIGSTOP)
    big = 40_000
    robot.send(big)  # far more than the kernel keeps
    os.kill(pid, signal.SIGCONT)
    wait_until(lambda: len(numbers(path)) > 10, 15, "it does not go on")
    robot.send(1)
    process.end()
    kept = numbers(path)
    lost = json.loads(Summary(BagReader(path)).end["lost"])
    assert lost == {"localization": big + 11 - len(kept)}
    assert lost["localization"] > 0
    assert kept[-1] == big + 11


def test_a_launcher_that_has_ended_before_its_recorder_has_begun_leaves_no_recorder(
        port, tmp_path, dead):
    stop, write_end = os.pipe()
    recorder = Recorder(port, tmp_path / "run.mcap", launcher=dead)
    recorder.open()
    assert recorder.run(stop) == "the run has ended"
    os.close(write_end)
    os.close(stop)
    assert list(tmp_path.iterdir()) == []


def test_what_nodes_send_after_their_launcher_has_ended_is_recorded(port, tmp_path, dead):
    path = tmp_path / "run.mcap"
    with AnsweringLauncher(port, time.monotonic(), dead):
        recorder = Recorder(port, path)
        recorder.open()
        robot = Robot(port)
        robot.send(1)
        with running(recorder, is_told=False):
            wait_until(path.exists, 15, "it has not begun")
            for _ in range(20):
                time.sleep(0.02)
                robot.send()
            robot.connection.close()
    assert numbers(path) == list(range(1, 22))
    assert Summary(BagReader(path)).end["ended"] == "the run has ended"


def test_a_recorder_that_does_not_start_is_not_waited_for(port, tmp_path, monkeypatch):
    program = tmp_path / "python"
    program.write_text("#!/bin/sh\nexec sleep 60\n")
    program.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(program))
    monkeypatch.setattr("rampart.actors.recording.process._START_S", 0.2)
    recorder = RecorderProcess(Order(port, str(tmp_path / "run.mcap"), os.getpid()))
    with pytest.raises(BagError, match=r"the recorder did not start within 0\.2 s"):
        recorder.start()
    assert pid_of("recorder", port) is None
    recorder.end()


def test_a_recorder_that_is_stopped_when_its_launcher_dies_is_not_left_over(port, tmp_path):
    script = (
        "import sys, os\n"
        "from rampart.actors.recording.process import Order, RecorderProcess\n"
        f"r = RecorderProcess(Order({port}, {str(tmp_path / 'run.mcap')!r}, os.getpid()))\n"
        "r.start(); print('started', flush=True); input()\n")
    parent = subprocess.Popen([sys.executable, "-c", script], stdin=subprocess.PIPE,
                              stdout=subprocess.PIPE, cwd=ROOT, text=True)
    assert parent.stdout.readline().strip() == "started"
    os.kill(pid_of("recorder", port), signal.SIGSTOP)
    parent.kill()
    parent.wait()
    parent.stdin.close()
    parent.stdout.close()
    wait_until(lambda: pid_of("recorder", port) is None, 15, "the recorder was left")


def test_a_full_disk_is_said_and_ends_only_the_recording(port, launcher, capfd):
    with AnsweringLauncher(port, time.monotonic(), launcher.pid):
        process = RecorderProcess(Order(port, "/dev/full", launcher.pid, overwrite=True))
        process.start()
        robot = Robot(port)
        robot.send(10)
        wait_until(lambda: pid_of("recorder", port) is None, 15, "it lives")
        robot.send(10)
        wait_until(lambda: "No space left" in process.problem(), 5, "it does not say why")
        process.end()
        assert "No space left" in process.problem()
    error = capfd.readouterr().err
    assert "/dev/full: No space left on device: the recording ends after" in error
    assert error.count("\n") == 1


def test_a_disk_without_room_for_others_ends_the_recording(tmp_path, monkeypatch):
    with (tmp_path / "run.mcap").open("wb") as file:
        writer = BagWriter(file, documents())
        writer.take(*pose(1, 0.0))
        whole = os.statvfs(tmp_path)
        monkeypatch.setattr(os, "statvfs", lambda _fd: SimpleNamespace(
            f_blocks=whole.f_blocks, f_frsize=whole.f_frsize, f_bavail=1))
        with pytest.raises(OSError, match="are free on its disk"):
            writer.flush()
    assert numbers(tmp_path / "run.mcap") == [1]


def test_a_frame_comes_back_and_a_broken_one_is_refused():
    assert parse_frame(frame(1.5, "rampart/küche", b"\x00\xff")) == (
        1.5, "rampart/küche", b"\x00\xff")
    for broken in (b"", b"\x00" * 9, frame(0.0, "abc", b"")[:-1], frame(0.0, "é", b"")[:11],
                   frame(float("nan"), "abc", b"")):
        with pytest.raises(ValueError, match=r"frame|announced"):
            parse_frame(broken)


def test_a_node_without_a_descriptor_left_goes_on_unrecorded(port, monkeypatch):
    def none_left(*_arguments: object) -> None:
        raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))

    node = RecorderConnection(port)
    monkeypatch.setattr(socket, "socket", none_left)
    node.take("rampart/k", b"")


def test_topics_that_nobody_wants_are_left_out_and_gaps_are_told_all_the_same(port, tmp_path):
    path = tmp_path / "run.mcap"
    recorder = Recorder(port, path, wants=lambda key: "detection" in key)
    recorder.open()
    with AnsweringLauncher(port, time.monotonic()), running(recorder):
        robot = Robot(port)
        robot.send(5)
        robot.sent += 3  # lost somewhere
        robot.send(1)
        wait_until(path.exists, 15, "it has not begun")
    robot.connection.close()
    assert numbers(path) == []
    assert Summary(BagReader(path)).end["lost"] == '{"localization": 3}'
    assert result_of(recorder) == f"recorded 0 messages in {path}, 3 lost"


@pytest.mark.parametrize(("arguments", "words"), [
    (["--topics", "detection/*", "nothing/like/it"], "--topics nothing/like/it: matches no topic"),
    (["--duration", "0"], "--duration 0: must be above 0"),
    (["--port", "31999"], "--port 31999: no run there")])
def test_a_wish_that_makes_no_sense_is_refused(port, tmp_path, capsys, arguments, words):
    with AnsweringLauncher(port, time.monotonic()):
        code = main(["record", str(tmp_path / "x.mcap"), "--port", str(port), *arguments])
    assert code == 2
    assert words in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.processes
def test_of_other_hosts_each_message_that_comes_by_the_bus_is_written_once_and_in_order(
        port, tmp_path):
    path, origin_s = tmp_path / "run.mcap", time.monotonic()

    def beat(source, sequence, incarnation=1):
        header = Header(source, incarnation, sequence, time.monotonic() - origin_s)
        return HEARTBEAT.at(source), encode(header, Heartbeat(1, 2, 0.1, 0, 0))

    folder = run_folder.make(port, os.getpid())
    recorder = Recorder(port, path, launcher=os.getpid())
    router = zenoh.open(session_config([endpoint(folder, "router_a")], []))
    try:
        with AnsweringLauncher(port, origin_s) as launcher:
            launcher.info = msgspec.structs.replace(
                launcher.info, folder=folder, hosts={"robot": "supervisor", "ground": "other"})
            recorder.open()
            here = RecorderConnection(port)
            listened = router.declare_publisher(HEARTBEAT.at("hmi"))
            with running(recorder):
                wait_until(lambda: listened.matching_status.matching, 10, "nobody listens")
                for message in ((HEARTBEAT.at("pilot"), b"\xc1"), beat("hmi", 1, 1_000_001)):
                    here.take(*message)
                    router.put(*message)
                for number in range(1, 51):
                    here.take(*beat("pilot", number))
                    for name in ("pilot", "hmi"):  # the pilot's has been handed over, too
                        router.put(*beat(name, number))
                router.put(HEARTBEAT.at("hmi"), b"\xc2")
                wait_until(lambda: recorder.messages >= 103, 10, "they are not recorded")
                here.take(*beat("pilot", 51))  # in the last turn
            here.close()
    finally:
        router.close()
        run_folder.remove(folder)
    found = [(key, message.sequence, message.log_time)
             for channel, message in BagReader(path).messages() if (key := key_of(channel))]
    for name, more in (("pilot", [0, 51]), ("hmi", [0, 1])):  # garbage, and of a process here
        assert sorted(n for key, n, _ in found if key == HEARTBEAT.at(name)) == sorted(
            [*more, *range(1, 51)])
    assert [at for _, _, at in found] == sorted(at for _, _, at in found)
    assert json.loads(Summary(BagReader(path)).end["lost"]) == {}


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
def test_a_run_that_is_there_is_recorded_until_ctrl_c_or_the_terminal_is_closed(
        port, tmp_path, number):
    path = tmp_path / "run.mcap"
    robot = Robot(port)
    robot.send(10)  # nobody records yet
    with AnsweringLauncher(port, time.monotonic() - 100.0):
        verb = subprocess.Popen(
            [*HEEDS_SIGNALS, sys.executable, "-m", "rampart.cli.main", "record", str(path),
             "--port", str(port), "--topics", "localization/*"], cwd=ROOT,
            stdout=subprocess.PIPE, text=True)

        def is_written() -> list[int]:
            robot.connection.take("rampart/detection/DM1", b"")  # which nobody wants
            robot.send()
            return numbers(path)

        wait_until(is_written, 30, "nothing is written")
        verb.send_signal(number)
        told = verb.communicate(timeout=20)[0]
    robot.connection.close()
    assert verb.returncode == 0, told
    kept = numbers(path)
    assert f"recorded {len(kept)} messages in {path}, none lost; it ends because" in told
    assert kept == list(range(kept[0], kept[-1] + 1))
    assert kept[0] > 10
    summary = Summary(BagReader(path))
    assert set(summary.keys) == {topics.POSE.at()}
    assert summary.reader.closed
    assert summary.time_zero_s == 0.0
    assert summary.first_ns >= 100e9


@pytest.mark.parametrize("error", [
    BagError("it is full"), ValueError("no number"), OSError(24, "Too many open files")])
def test_a_recording_that_fails_is_one_line(port, tmp_path, monkeypatch, capsys, error):
    def fail(*_):
        raise error

    monkeypatch.setattr(Recorder, "run", fail)
    monkeypatch.setattr("rampart.cli.record.record_verbs.stop_pipe", lambda: -1)
    with AnsweringLauncher(port, time.monotonic()):
        assert main(["record", str(tmp_path / "x.mcap"), "--port", str(port)]) == 1
    assert capsys.readouterr().err == f"rampart: {error}\n"


@pytest.mark.processes
@pytest.mark.alone
def test_a_real_run_is_recorded_whole_with_a_node_killed_on_the_way(tmp_path):
    path = tmp_path / "run.mcap"
    with RealRun(tmp_path, "paper", "--record", str(path), "--rate", "2") as run:
        run.sleep_until(4)
        run.kill("localization")
        run.wait_until(lambda: (run.pid("localization") or 0) > 0, 5, "it does not come back")
        heard = run.tool("topic", "echo", "localization/pose", "-n", "1")
        assert heard.returncode == 0, heard.stderr
        run.sleep_until(8)
        run.process.send_signal(signal.SIGTERM)
        run.result()
    assert pid_of("recorder", run.port) is None
    summary = Summary(BagReader(path))
    assert (summary.reader.closed, summary.reader.damage) == (True, "")
    assert (summary.end["lost"], summary.end["ended"]) == ("{}", "the run has ended")
    assert summary.run["mission"] == "AB"
    lives = {}
    for channel, message in BagReader(path).messages():
        if (key := key_of(channel)) is not None:
            header = header_of(Forms(topics.ALL).of(key).payload(message.data))
            lives.setdefault((header.source, header.incarnation), set()).add(header.sequence)
    assert ("localization", 2) in lives
    gaps = {life for life, heard in lives.items() if heard != set(range(1, len(heard) + 1))}
    assert gaps == set()
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert reader.get_summary().statistics.message_count == summary.messages
        assert sum(1 for _ in reader.iter_messages(topics=["view/tf"])) > 20


@pytest.mark.processes
@pytest.mark.alone
def test_a_recorder_that_dies_in_a_run_is_seen_by_status_result_and_report(tmp_path):
    path = tmp_path / "run.mcap"
    with RealRun(tmp_path, "paper", "--record", str(path), "--rate", "2") as run:
        run.sleep_until(3)
        os.kill(pid_of("recorder", run.port), signal.SIGKILL)
        found = {}

        def seen():
            found.update(json.loads(run.tool("status", "--json").stdout)["recording"])
            return found["problem"]

        run.wait_until(seen, 10, "status does not show it")
        assert found["file"] == str(path)
        run.process.send_signal(signal.SIGTERM)
        _, result = run.result()
    assert result["recording"] == found
    kept = json.loads(Path(result["record"]).read_text())
    assert any("recorder" in event["text"] for event in kept["events"])
