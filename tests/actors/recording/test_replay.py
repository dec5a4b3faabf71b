"""What is played back is what was recorded, readers take it, and no robot can hear it."""

import asyncio
import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from types import SimpleNamespace

import msgspec
import mujoco
import pytest
from websockets.asyncio.client import connect as open_socket

from rampart.actors.bus import messages as bm
from rampart.actors.bus import run_info
from rampart.actors.bus.envelope import Header, encode
from rampart.actors.bus.topic import ROOT
from rampart.actors.bus.zenoh_bus import ZenohBus
from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.operator.requests import REQUESTS, ResetRequest
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.application import Osmosis
from rampart.actors.osmosis.page.state import OsmosisState
from rampart.actors.recording.bag_reader import BagReader, key_of
from rampart.actors.recording.bag_writer import BagWriter
from rampart.actors.recording.message_form import Forms, MessageForm
from rampart.actors.recording.run_documents import collect
from rampart.actors.supervision.process_title import RunProcess
from rampart.cli.main import main
from rampart.cli.output import UsageError
from rampart.cli.record import replaying
from rampart.cli.record.replaying import HEIGHT, WIDTH, RecordedRun, Replay, Stage
from rampart.cli.session import connect
from rampart.systems import SHIPPED
from rampart.testing import HEEDS_SIGNALS, eventually, free_base_port, wait_until
from tests import ROOT as HERE
from tests.actors.recording.samples import AnsweringLauncher, documents, pose, sample, write


@contextlib.asynccontextmanager
async def playing(player, delay_s=0.5):
    """A replay that runs meanwhile, on a loop of its own: who asks it for its run waits."""
    loop = asyncio.get_running_loop()
    ready, stops = asyncio.Event(), []

    async def play():
        stops.append((asyncio.get_running_loop(), stop := asyncio.Event()))
        loop.call_soon_threadsafe(ready.set)
        await player.run(stop, delay_s)

    task = loop.run_in_executor(None, asyncio.run, play())
    await ready.wait()
    try:
        yield task
    finally:
        with contextlib.suppress(RuntimeError):  # it has come to its end
            stops[0][0].call_soon_threadsafe(stops[0][1].set)
        await task


@contextlib.asynccontextmanager
async def reading(port, *keys):
    """All that can be heard on keys meanwhile: key and payload in order."""
    heard = []

    def found():
        return [run for run in run_info.find_runs() if run.base_port == port]

    await eventually(lambda: bool(found()))
    bus = ZenohBus("", found()[0].endpoints)
    await bus.open()
    for key in keys:
        bus.subscribe(key, lambda key, payload: heard.append((key, payload)))
    try:
        yield heard
    finally:
        await bus.close()


@pytest.mark.parametrize(("start_s", "part", "count"), [(None, "", 24), (0.3, "detection/", 1)])
async def test_readers_hear_all_that_is_wanted_as_it_was_sent_garbage_and_nan_included(
        recording, port, start_s, part, count):
    wanted = f"{ROOT}/{part}"
    player = Replay(recording, port=port, rate=4.0, start_s=start_s,
                    wants=lambda key: key.startswith(wanted))
    async with playing(player) as task, reading(port, f"{ROOT}/**") as heard:
        await task
    sent = [(key, payload) for at_s, key, payload in sample()
            if key.startswith(wanted) and at_s >= (start_s or 0.0)]
    assert sorted(heard) == sorted(sent)
    assert [said for said in heard if said[0] == topics.POSE.at()] == [
        said for said in sent if said[0] == topics.POSE.at()]
    assert (player.played, player.refused) == (len(sent), 0) == (count, 0)


async def test_what_lies_before_the_start_is_not_decoded_and_not_caught_up_with(
        tmp_path, port, monkeypatch):
    write(tmp_path / "run.mcap", [pose(n + 1, n * 0.2) for n in range(206)])
    sent, decoded, messages, payload = [], [], BagReader.messages, MessageForm.payload

    def slow(reader):  # as of a file that is 1000 times as large
        for found in messages(reader):
            time.sleep(0.005)
            yield found

    monkeypatch.setattr(BagReader, "messages", slow)
    monkeypatch.setattr(MessageForm, "payload", lambda form, text: (
        decoded.append(text), payload(form, text))[1])
    player = Replay(tmp_path / "run.mcap", port=port, start_s=40.0)
    player.viewer = lambda *_: not sent.append(time.monotonic())
    await player.run(asyncio.Event())
    assert len(sent) == len(decoded) == 6
    assert sent[-1] - sent[0] > 0.9, "one each 0.2 s, never sooner"


async def test_a_recording_of_which_nothing_can_be_read_ends(recording, port, monkeypatch):
    monkeypatch.setattr(Forms, "of", lambda *_: MessageForm(None))
    monkeypatch.setattr(MessageForm, "payload", lambda *_: int("no payload"))
    player = Replay(recording, port=port)
    await player.run(asyncio.Event())
    assert player.played == 0


async def test_a_page_that_fails_is_said_to_have_ended(recording, port, monkeypatch):
    def fail(*_):
        raise RuntimeError("it is\nbroken")

    monkeypatch.setattr(OsmosisState, "pose", fail)
    said = []
    player = Replay(recording, port=port, hmi_port=port + 30, rate=4.0, report=said.append)
    async with asyncio.timeout(60):
        await player.run(asyncio.Event(), 0.5)
    assert said[-1] == "the page has ended: RuntimeError: it is broken"


def test_a_replay_leaves_nothing_behind_when_its_terminal_is_closed(recording, tmp_path, port):
    folder = tmp_path / "folder"
    folder.mkdir()
    verb = subprocess.Popen(
        [*HEEDS_SIGNALS, sys.executable, "-m", "rampart.cli.main", "replay",
         str(recording),
         "--rate", "0.01", "--port", str(port)], cwd=HERE, stdout=subprocess.PIPE, text=True,
        env={**os.environ, "TMPDIR": str(folder)})
    assert "playing" in verb.stdout.readline()
    wait_until(lambda: any(folder.iterdir()), 30)
    verb.send_signal(signal.SIGHUP)
    told = verb.communicate(timeout=30)[0]
    assert (verb.returncode in (0, 1), "played" in told) == (True, True), told
    assert list(folder.iterdir()) == []


async def test_tools_find_a_replay_that_is_no_robot_and_takes_no_orders(
        recording, port, monkeypatch):
    other, found, second = free_base_port(), run_info.find_runs, Replay(recording, port=port)
    async with playing(Replay(recording, port=port, rate=0.05)), reading(port):
        async with connect(port) as session:
            assert session.run.replay_of.endswith("run.mcap")
            assert session.run.title == "replay of run.mcap: a sample"
            assert set(session.run.nodes) == {"localization", "DM1"}
            latest = await session.latest((topics.POSE,), 10.0)
            assert isinstance(latest[topics.POSE.key], m.Pose)
            with pytest.raises(UsageError, match=f"port {port} is a replay of"):
                await session.command(ftm_topics.RESET, fm.Reset("RM1", "me"), lambda: True, 1.0)
        with pytest.raises(UsageError, match=f"--port {port}: in use"):
            await second.run(asyncio.Event())
        monkeypatch.setattr(run_info, "find_runs", lambda: [
            run for run in found() if run.base_port in (port, other)])
        assert run_info.find_run().replay_of
        with AnsweringLauncher(other, 0.0):  # who names no port means the robot
            assert run_info.find_run().base_port == other
            assert run_info.find_run(port).replay_of


def test_a_port_in_use_is_refused(recording, port, capsys, monkeypatch):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", port))
        taken.listen()
        assert main(["replay", str(recording), "--hmi-port", str(port)]) == 2
        assert f"--hmi-port {port}: in use" in capsys.readouterr().err
    with AnsweringLauncher(port, 0.0):  # none of whose nodes lives just now
        assert main(["replay", str(recording), "--port", str(port)]) == 2
    assert f"--port {port}: belongs to a run" in capsys.readouterr().err
    node = RunProcess(1, port, 1, ("localization",), 1)
    monkeypatch.setattr(replaying, "find_processes", lambda: [node])
    with pytest.raises(UsageError, match=f"--port {port}: belongs to a run"):
        Replay(recording, port=port)


@pytest.mark.parametrize(("arguments", "words"), [
    (["--topics", "nothing"], "--topics nothing: matches no topic; known: detection/…"),
    (["--rate", "0"], "--rate 0: must be between"), (["--rate", "nan"], "--rate nan"),
    (["--start", "1000"], "--start 1000: the recording goes from 0.0 to 0.9"),
    (["--hmi-port", "80"], "--hmi-port 80: must be between 1024"),
    (["--port", "7411", "--hmi-port", "7411"], "--hmi-port 7411: is the replay's own --port")])
def test_a_replay_that_makes_no_sense_is_refused_in_one_line(
        recording, port, refused, arguments, words):
    assert words in refused("replay", recording, "--port", port, *arguments)


def test_a_recording_without_messages_has_nothing_to_play(tmp_path, port, capsys):
    with (tmp_path / "run.mcap").open("wb") as file:
        BagWriter(file, documents()).close()
    assert main(["replay", str(tmp_path / "run.mcap"), "--port", str(port)]) == 2
    assert "no message to play" in capsys.readouterr().err


def test_a_torn_recording_is_played_as_far_as_it_goes(tmp_path, port, capsys):
    path = tmp_path / "run.mcap"
    write(path, sample(100))
    path.write_bytes(path.read_bytes()[:-9000])
    assert main(["replay", str(path), "--port", str(port), "--rate", "50"]) == 0
    shown = capsys.readouterr().out
    assert "damaged (" in shown
    assert "played" in shown


def test_messages_of_another_version_are_left_out_and_counted(tmp_path, port, capsys):
    path = tmp_path / "run.mcap"
    write(path, [pose(1, 0.0), pose(2, 0.1)])
    reader = BagReader(path)
    texts = [message.data for channel, message in reader.messages() if key_of(channel)]
    from mcap.writer import Writer

    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("rampart")
        writer.add_metadata("rampart.run", {"time_zero_s": "0"})
        writer.add_attachment(0, 0, "system.toml", "", (SHIPPED / "paper.toml").read_bytes())
        channel = writer.register_channel("localization/pose", "json", 0, {"key": topics.POSE.at()})
        writer.add_message(channel, 0, texts[0], 0)
        writer.add_message(channel, 1, texts[1].replace(b"yaw_rad", b"heading"), 1)
        writer.finish()
    assert main(["replay", str(path), "--port", str(port)]) == 0
    assert "played 1 messages, 1 of another version left out" in capsys.readouterr().out


def of_osmosis(path):
    manager = fm.ManagerStatus(("FTM1",), (), ("RM1",), ("RM1",), "safety-first", 1)
    write(path, sorted([
        *(pose(n + 1, n * 0.05) for n in range(20)),
        *((n * 0.1, ftm_topics.MANAGER_STATUS.at(),
           encode(Header("ftm_manager", 1, n + 1, n * 0.1), manager)) for n in range(10))]))
    return "FTM1"


def of_a_robot_without_application(path):
    assert main(["new", "courier"]) == 0
    known = collect({"system_file": str(path.with_name("courier") / "courier.toml")}, run_id="r",
                    title="courier", rate=1.0, nodes=("controller",), started="")
    with path.open("wb") as file:
        writer = BagWriter(file, known, views=known.known.views())
        body = bm.Heartbeat(1, 2, 0.1, 0, 0)
        for number in range(1, 30):
            header = Header("controller", 1, number, number / 20)
            writer.take(number / 20, "rampart/heartbeat/controller", encode(header, body))
            writer.take(number / 20, "rampart/world/truth", encode(header, body))
        writer.close()
    return '"courier"'


@pytest.mark.parametrize("written", [of_osmosis, of_a_robot_without_application])
async def test_the_page_shows_the_past_and_obeys_nobody(tmp_path, port, monkeypatch, written):
    monkeypatch.chdir(tmp_path)
    shown = written(tmp_path / "run.mcap")
    page_port, seen, told = port + 30, "", {}
    player = Replay(tmp_path / "run.mcap", port=port, hmi_port=page_port)
    async with playing(player), reading(port, ftm_topics.RESET.at()) as heard:
        url = f"http://127.0.0.1:{page_port}/"
        document = await asyncio.to_thread(lambda: urllib.request.urlopen(url).read())
        assert b"<html" in document
        async with open_socket(f"ws://127.0.0.1:{page_port}/ws") as page, asyncio.timeout(15):
            await page.send(msgspec.json.encode(ResetRequest("RM1")).decode())
            while not ({"hello", "visitor", "state"} <= told.keys()
                       and "no robot can obey" in seen and shown in seen):
                message = json.loads(await page.recv())
                told[message["type"]] = message
                seen += json.dumps(message)
        assert heard == []
    assert told["hello"]["badge"] == "replay"
    assert ("map" in told["hello"]) is (written is of_osmosis)
    assert set(told["visitor"]["barred"]) >= {str(kind.__struct_config__.tag) for kind in REQUESTS}
    assert main(["bag", "info", str(tmp_path / "run.mcap")]) == 0


# -- In MuJoCo: as a video, which another program reads, and in the viewer --


def test_a_video_has_a_frame_each_25th_of_a_second_and_the_robot_moves(recording):
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    path = recording.with_suffix(".mp4")
    done = subprocess.run(
        [sys.executable, "-m", "rampart.cli.main", "replay", str(recording), "--video", str(path),
         "--rate", "8"], cwd=HERE, capture_output=True, text=True, check=False, timeout=100)
    if done.returncode == 1 and "cannot render" in done.stderr:
        pytest.skip(done.stderr)
    assert done.returncode == 0, done.stderr
    pixels = subprocess.run(
        [ffmpeg.get_ffmpeg_exe(), "-v", "error", "-i", path, "-f", "rawvideo", "-pix_fmt", "gray",
         "-"], capture_output=True, check=True).stdout
    size = WIDTH * HEIGHT
    assert len(pixels) == 4 * size  # of 0.95 s, each 0.32 s, and the last message
    assert pixels[:size] != pixels[-size:]


def test_the_model_stands_where_the_messages_put_it_and_ignores_what_is_no_pose(recording):
    stage = Stage(RecordedRun(recording))
    for number, yaw_rad in ((7, 0.5), (8, float("nan"))):
        stage.take(*pose(number, 0.1, yaw_rad)[1:])
    stage.take(topics.POSE.at(), b"\xc1")
    stage.take("rampart/no/such/topic", b"")
    assert stage.robot.data.qpos[0] == 7.0


@pytest.mark.parametrize(("words", "told"), [
    (["--video", "run.avi"], "--video run.avi: expected a name that ends in .mp4"),
    (["--video", "there.mp4"], "--video there.mp4: exists already"),
    (["--video", "no/such/place.mp4"], "there is no such directory"),
    (["--video", "new.mp4", "--viewer"], "--video new.mp4: plays nothing")])
def test_a_video_that_cannot_be_is_refused_in_one_line(
        recording, monkeypatch, refused, words, told):
    monkeypatch.chdir(recording.parent)
    recording.with_name("there.mp4").touch()
    assert told in refused("replay", recording, *words)


def test_a_machine_that_cannot_render_and_a_robot_without_a_model_are_told(
        recording, monkeypatch, capsys):
    def fail(*_):
        raise RuntimeError("no\nEGL")

    path = recording.with_suffix(".mp4")
    monkeypatch.setattr(mujoco, "Renderer", fail)
    assert main(["replay", str(recording), "--video", str(path)]) == 1
    assert "cannot render" in capsys.readouterr().err
    assert not path.exists()
    monkeypatch.setattr(Osmosis, "model", "")
    assert main(["replay", str(recording), "--video", str(path)]) == 2
    assert "has no model for MuJoCo" in capsys.readouterr().err


def test_the_viewer_shows_what_is_played_and_a_closed_window_ends_the_replay(
        recording, monkeypatch, capsys):
    import glfw
    import mujoco.viewer

    shown = []

    def launch(_model, data, **_):
        return SimpleNamespace(
            lock=contextlib.nullcontext, cam=SimpleNamespace(), close=lambda: shown.append("end"),
            opt=mujoco.MjvOption(), sync=lambda: shown.append(float(data.qpos[0])),
            is_running=lambda: len(shown) < 5)

    replay = ["replay", str(recording), "--viewer", "--port", str(free_base_port())]
    monkeypatch.setattr(glfw, "init", lambda: False)
    assert main(replay) == 1
    assert "--viewer: no window can be opened" in capsys.readouterr().err
    monkeypatch.setattr(glfw, "init", lambda: True)
    monkeypatch.setattr(mujoco.viewer, "launch_passive", launch)
    assert main(replay) == 0
    assert shown[-1] == "end"
    assert sorted(shown[:-1]) == shown[:-1]
    assert len(set(shown)) > 3
