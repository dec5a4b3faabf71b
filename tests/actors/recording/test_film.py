"""A recorded robot in MuJoCo: as a video, which another program reads, and in the viewer."""

import contextlib
import subprocess
import sys
from types import SimpleNamespace

import pytest

from rampart.actors.osmosis import topics
from rampart.actors.osmosis.application import Osmosis
from rampart.cli.main import main
from rampart.cli.record.replaying import HEIGHT, WIDTH, RecordedRun, Stage
from rampart.testing import free_base_port
from tests import ROOT
from tests.actors.recording.samples import pose

mujoco = pytest.importorskip("mujoco")


def test_a_video_has_a_frame_each_25th_of_a_second_and_the_robot_moves(recording):
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    path = recording.with_suffix(".mp4")
    done = subprocess.run(
        [sys.executable, "-m", "rampart.cli.main", "replay", str(recording), "--video", str(path),
         "--rate", "8"], cwd=ROOT, capture_output=True, text=True, check=False, timeout=100)
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
