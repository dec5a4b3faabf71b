"""A recorded robot in MuJoCo: in its viewer while a replay plays, or as a video."""

from __future__ import annotations

import contextlib
import os
import tempfile
import time
import warnings
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rampart.actors.bus.envelope import UNREADABLE, decode
from rampart.actors.recording.bag_writer import check_target, complete
from rampart.actors.recording.run_documents import restore
from rampart.actors.system.members import import_class
from rampart.cli.output import NoEffectError, UsageError
from rampart.cli.record.replaying import RecordedRun
from rampart.cli.verbs import extra

if TYPE_CHECKING:
    from rampart.sim.runs.physics import RobotModel

FRAMES_HZ = 25
"""Frames per second of a video, and of the viewer."""

WIDTH, HEIGHT = 960, 544
"""Pixels of a video; multiples of 16, as encoders need them."""


class Stage:
    """The model of a recorded robot, moved by recorded messages.

    Args:
        run: the recording.

    Attributes:
        robot: state of the robot after the messages so far.

    Raises:
        UsageError: the robot has no model, or it cannot be built.
    """

    def __init__(self, run: RecordedRun) -> None:
        summary, known = run.summary, run.known
        path = known.kind.model
        if not path:
            raise UsageError(f"{summary.reader.path}: the robot has no model for MuJoCo; expected "
                             "a class as `model` of its application")
        screen = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
        os.environ.setdefault("MUJOCO_GL", "glfw" if screen else "egl")
        try:
            from rampart.sim.runs.physics import RobotModel  # noqa: PLC0415 chooses MUJOCO_GL

            with tempfile.TemporaryDirectory(prefix="rampart-replay-") as folder:
                restore(summary.files, Path(folder))
                self.robot: RobotModel = import_class(path, RobotModel, "model")(
                    known.kind.restored(Path(folder)))
        except Exception as error:  # MuJoCo, its OpenGL, and classes of the user raise anything
            raise UsageError(f"{summary.reader.path}: its model cannot be built: "
                             f"{_words(error)}") from None
        self._forms = run.forms

    def take(self, key: str, payload: bytes) -> None:
        """Apply a message to the robot."""
        topic = self._forms.of(key).topic
        if topic is not None:
            with contextlib.suppress(*UNREADABLE):
                _, body = decode(topic, payload)
                self.robot.take(topic, body)


def film(run: RecordedRun, path: Path, rate: float) -> Generator[float, None, None]:
    """Write a video, and yield the simulated time of each frame when it is written.

    An incomplete video is not left behind.

    Args:
        run: the recording.
        path: ends in `.mp4`.
        rate: simulated seconds per second of the video.

    Raises:
        UsageError: the path cannot be used, or the robot has no model.
        BagError: it cannot be written.
        NoEffectError: this machine cannot render.
    """
    if path.suffix != ".mp4":
        raise UsageError(f"--video {path}: expected a name that ends in .mp4")
    if path.exists():
        raise UsageError(f"--video {path}: exists already; choose another name")
    check_target(path, overwrite=False)
    ffmpeg = extra("video", "imageio_ffmpeg")
    stage = Stage(run)
    robot = stage.robot
    with complete(path), _renderer(robot) as renderer, contextlib.closing(ffmpeg.write_frames(
            str(path), (WIDTH, HEIGHT), fps=FRAMES_HZ, ffmpeg_log_level="quiet")) as video:
        video.send(None)
        frame_s: float | None = None
        for due in filter(None, run.messages()):
            frame_s = due.at_s if frame_s is None else frame_s
            while frame_s <= due.at_s:
                video.send(_picture(renderer, robot))
                yield frame_s
                frame_s += rate / FRAMES_HZ
            stage.take(due.key, due.payload)
        video.send(_picture(renderer, robot))


@contextlib.contextmanager
def _renderer(robot: RobotModel) -> Iterator[Any]:
    import mujoco  # noqa: PLC0415 chooses how to render by MUJOCO_GL

    robot.model.vis.global_.offwidth, robot.model.vis.global_.offheight = WIDTH, HEIGHT
    try:
        renderer = mujoco.Renderer(robot.model, HEIGHT, WIDTH)
    except Exception as error:  # OpenGL raises anything
        raise NoEffectError(
            f"--video: this machine cannot render with MUJOCO_GL={os.environ.get('MUJOCO_GL')} "
            f"({_words(error)}); expected egl (Debian: libegl1, libgl1-mesa-dri), osmesa "
            "(libosmesa6) or a display") from None
    with contextlib.closing(renderer):
        yield renderer


def _picture(renderer: Any, robot: RobotModel) -> bytes:
    import mujoco  # noqa: PLC0415 as above

    mujoco.mj_forward(robot.model, robot.data)
    renderer.update_scene(robot.data, robot.camera, robot.options)
    picture: bytes = renderer.render().tobytes()
    return picture


class Viewer:
    """MuJoCo's viewer in a window, beside a replay.

    Args:
        stage: of the robot.

    Raises:
        NoEffectError: it cannot be opened.
    """

    def __init__(self, stage: Stage) -> None:
        self._stage = stage
        robot = stage.robot
        import glfw  # noqa: PLC0415 few replays open a window
        import mujoco.viewer  # noqa: PLC0415

        with warnings.catch_warnings(action="ignore"):
            if not glfw.init():  # MuJoCo would end the process
                raise NoEffectError("--viewer: no window can be opened; it needs a display, "
                                    "--video needs none")
        self._window = mujoco.viewer.launch_passive(
            robot.model, robot.data, show_left_ui=False, show_right_ui=False)
        with self._window.lock():
            self._window.cam.type = mujoco.mjtCamera.mjCAMERA_TRACKING
            self._window.cam.trackbodyid = 1
            self._window.cam.distance = robot.camera.distance
            self._window.opt.geomgroup[:] = robot.options.geomgroup
        self._next_s = 0.0

    def take(self, key: str, payload: bytes) -> bool:
        """Show what a message changes; False if the window was closed."""
        import mujoco  # noqa: PLC0415 as above

        self._stage.take(key, payload)
        if time.monotonic() >= self._next_s:
            mujoco.mj_forward(self._stage.robot.model, self._stage.robot.data)
            self._window.sync()
            self._next_s = time.monotonic() + 1 / FRAMES_HZ
        return bool(self._window.is_running())

    def close(self) -> None:
        """Close the window."""
        self._window.close()


def _words(error: Exception) -> str:
    """Return an error as one line."""
    return f"{type(error).__name__}: {' '.join(str(error).split())}".rstrip(": ")
