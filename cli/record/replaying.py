"""`rampart replay`: a recording on a separate bus, in MuJoCo's viewer, or as a video.

A replay must never reach a robot. It is a router with a socket in a separate folder; the nodes of a
run know only the routers in the folder of their run. Tools find a replay as they find a run, and
its description names the recording: they give it no orders, and prefer a run to it.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import fnmatch
import os
import socket
import tempfile
import time
import warnings
from collections.abc import (
    AsyncGenerator,
    AsyncIterator,
    Callable,
    Generator,
    Iterable,
    Iterator,
)
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import msgspec
import tomli_w

from rampart.actors.bus import run_folder, run_info
from rampart.actors.bus.bus import shared
from rampart.actors.bus.envelope import UNREADABLE, decode
from rampart.actors.bus.messages import Message
from rampart.actors.bus.recorder_connection import RecorderConnection
from rampart.actors.bus.topic import ROOT, Qos, Topic
from rampart.actors.bus.zenoh_bus import ZenohBus
from rampart.actors.bus.zenoh_session import endpoint
from rampart.actors.operator.hmi import Hmi
from rampart.actors.operator.panels import Panel
from rampart.actors.recording.bag_reader import BagReader, Summary, key_of
from rampart.actors.recording.bag_writer import check_target, complete
from rampart.actors.recording.message_form import Forms
from rampart.actors.recording.run_documents import (
    NOT_CHOSEN,
    SYSTEM,
    RunContents,
    recorded_system,
    restore,
)
from rampart.actors.runtime.actor import Context
from rampart.actors.runtime.clock import Clock
from rampart.actors.runtime.run_context import RunContext
from rampart.actors.runtime.run_plan import RunPlan
from rampart.actors.supervision.process_title import find_processes
from rampart.actors.system.members import import_class, load_class
from rampart.actors.web.access import PagePlan
from rampart.cli.output import (
    NoEffectError,
    UsageError,
    between,
    progress,
    say,
)
from rampart.cli.session import pause, stopped_by_signals
from rampart.cli.verbs import (
    extra,
    flag,
    number,
    option,
    whole,
    word,
)
from rampart.manager.spec.schema import Kind

if TYPE_CHECKING:
    from rampart.sim.runs.physics import RobotModel

DEFAULT_PORT = 7400
PAGE = "replay_page"
"""Name of the operator's page of a replay, different from that of the recorded page."""

_STRANGE: Topic[Any] = Topic("", Message, Qos.SENSOR, 0, "", "What was recorded on no topic's key.")
_YIELD_EVERY = 50
_LINGER_S = 0.3


class Due(NamedTuple):
    """A message to be played: simulated time, key and recorded payload."""

    at_s: float
    key: str
    payload: bytes


class ReplayPage(Hmi):
    """The operator's page of a replay: it shows everything, and refuses all orders."""

    badge = "replay"
    refuses = "This is a replay: no robot can obey"

    def _look(self) -> None:
        """Measure nothing: the recorded process numbers may belong to other processes today."""


class RecordedRun:
    """The messages of a recording that are to be played.

    Args:
        path: file of the recording.
        start_s: simulated time at which to begin; None for the beginning.
        wants: whether a full key is played.

    Attributes:
        summary: summary of the recording.
        known: system of the recording.
        refused: number of messages of another version, which are not played.

    Raises:
        BagError: the file cannot be read.
        UsageError: it is not a recording of a run, or it has no message to play.
    """

    def __init__(self, path: Path, *, start_s: float | None = None,
                 wants: Callable[[str], bool] = lambda _key: True) -> None:
        self.summary = summary = Summary(BagReader(path))
        self.document, self.known = recorded_system(summary.files)
        self.forms = Forms(self.known.topics)
        self.refused = 0
        self._path = path
        self._wants = wants
        if not summary.reader.is_recording:
            raise UsageError(f"{path}: an MCAP file of {summary.reader.library or 'others'}; "
                             "expected a recording of a run")
        if not any(wants(key) for key in summary.keys) or summary.first_ns is None:
            raise UsageError(f"{path}: no message to play")
        first_s = summary.first_ns / 1e9 + summary.time_zero_s
        last_s = summary.last_ns / 1e9 + summary.time_zero_s
        self._start_s = first_s if start_s is None else max(start_s, first_s)
        if self._start_s > last_s:
            raise UsageError(f"--start {start_s:g}: the recording goes from {first_s:.1f} to "
                             f"{last_s:.1f} simulated seconds")

    def messages(self) -> Iterator[Due | None]:
        """Yield the messages to be played, and None for each other message."""
        zero_s = self.summary.time_zero_s
        for channel, message in BagReader(self._path).messages():
            at_s, key, payload = message.log_time / 1e9 + zero_s, key_of(channel), None
            if key is not None and at_s >= self._start_s and self._wants(key):
                try:
                    payload = self.forms.of(key).payload(message.data)
                except (ValueError, RecursionError):  # of another version of this program
                    self.refused += 1
            yield None if key is None or payload is None else Due(at_s, key, payload)


class Replay(RecordedRun):
    """A recorded run that is played onto a bus. Use: `run`, once.

    Args:
        path: file of the recording.
        port: base port by which tools find it.
        rate: simulated seconds per second.
        hmi_port: port of an operator's page; 0 for none.
        report: called with each line for the user.
        chosen: as in `RecordedRun`.

    Attributes:
        viewer: called with key and payload of each message; returns whether to continue.

    Raises:
        BagError: as of `RecordedRun`.
        UsageError: as of `RecordedRun`, or a port is in use.
    """

    def __init__(self, path: Path, *, port: int = DEFAULT_PORT, rate: float = 1.0,
                 hmi_port: int = 0,
                 report: Callable[[str], None] = lambda _line: None, **chosen: Any) -> None:
        super().__init__(path, **chosen)
        self.played = 0
        self._port = port
        self._rate = rate
        self._hmi_port = hmi_port
        self.viewer: Callable[[str, bytes], bool] = lambda _key, _payload: True
        self._report = report
        self._sockets = ""
        claim_port(port)
        if hmi_port:
            try:
                socket.create_server(("127.0.0.1", hmi_port)).close()
            except OSError:
                raise UsageError(f"--hmi-port {hmi_port}: in use; choose another --hmi-port"
                                 ) from None

    async def run(self, stop: asyncio.Event, delay_s: float = 0.0) -> None:
        """Play to the end, or until `stop` is set; a page stays until then.

        Args:
            stop: ends the replay.
            delay_s: real seconds before the first message, in which readers can connect.

        Raises:
            UsageError: the base port is in use, or the folder cannot be created.
        """
        async with contextlib.aclosing(self._until_stopped(stop)) as messages:
            due = await anext(messages, None)  # before the clock starts: it may take long
            clock = Clock(time.monotonic() + delay_s - self._start_s / self._rate, self._rate)
            async with self._on_the_bus(clock) as (bus, page):
                while due and await _until(clock.source_time(due.at_s), stop):
                    bus.publish(self.forms.of(due.key).topic or _STRANGE, due.key, due.payload)
                    self.played += 1
                    if not self.viewer(due.key, due.payload):
                        stop.set()
                    due = await anext(messages, None)
                if page and not page.done() and not stop.is_set():
                    self._report("the recording is over; the page stays until Ctrl-C")
                    stopped = asyncio.create_task(stop.wait())
                    await asyncio.wait((page, stopped), return_when=asyncio.FIRST_COMPLETED)
                    stopped.cancel()
                await asyncio.sleep(_LINGER_S)  # the last messages are still on their way

    @contextlib.asynccontextmanager
    async def _on_the_bus(self, clock: Clock
                          ) -> AsyncIterator[tuple[ZenohBus, asyncio.Task[None] | None]]:
        """Open a bus that tools find; yield it, and the page's task if there is a page."""
        with contextlib.ExitStack() as stack:
            try:
                self._sockets = run_folder.make(self._port, os.getpid())
            except OSError as error:
                raise UsageError(f"cannot create the folder of a socket: {error}") from None
            stack.callback(run_folder.remove, self._sockets)
            folder = Path(stack.enter_context(
                tempfile.TemporaryDirectory(prefix="rampart-replay-")))
            stack.enter_context(self._answering(clock, folder))
            bus = ZenohBus("", [], [endpoint(self._sockets, run_info.REPLAY)],
                           RecorderConnection(self._port))
            await bus.open()
            page = self._page(bus, clock, folder)
            showing = asyncio.create_task(page.run()) if page else None
            if showing:
                showing.add_done_callback(self._page_ended)
            try:
                yield bus, showing
            finally:
                if page and showing:
                    page.stop()
                    await asyncio.gather(showing, return_exceptions=True)
                await bus.close()

    # -- playing --------------------------------------------------------------------------------

    async def _until_stopped(self, stop: asyncio.Event) -> AsyncGenerator[Due, None]:
        """Yield the messages to be played, until `stop`, and let other tasks run."""
        for index, due in enumerate(self.messages()):
            if index % _YIELD_EVERY == 0:
                await asyncio.sleep(0)
            if stop.is_set():
                return
            if due is not None:
                yield due

    def _page_ended(self, page: asyncio.Task[None]) -> None:
        if not page.cancelled() and (error := page.exception()) is not None:
            words = " ".join(str(error).split())
            self._report(f"the page has ended: {type(error).__name__}: {words}")

    # -- discovery ------------------------------------------------------------------------------

    @contextlib.contextmanager
    def _answering(self, clock: Clock, folder: Path) -> Iterator[None]:
        """Answer tools that look for a run, as a launcher does."""
        listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_NONBLOCK)
        loop = asyncio.get_running_loop()
        try:
            listener.bind(run_info.address(self._port))
        except OSError:
            listener.close()
            raise UsageError(f"--port {self._port}: in use by a run or another replay") from None
        listener.listen(8)
        loop.add_reader(listener, run_info.answer, listener, self._info(clock, folder))
        try:
            yield
        finally:
            loop.remove_reader(listener)
            listener.close()

    def _info(self, clock: Clock, folder: Path) -> run_info.RunInfo:
        run = self.summary.run
        try:
            nodes = msgspec.json.decode(run.get("nodes", "[]"), type=list[str])
        except UNREADABLE:
            nodes = []
        system = folder / SYSTEM
        if self.document:
            system.write_text(tomli_w.dumps(self.document), encoding="utf-8")
        page = f"http://127.0.0.1:{self._hmi_port}/" if self._hmi_port else ""
        plan = {name: value for name, value in run.items() if name not in NOT_CHOSEN}
        return run_info.RunInfo(
            os.getpid(), self._port, self._rate, clock.source_time(0.0),
            str(system) if system.exists() else "", self._sockets, tuple(nodes or ["replay"]),
            run.get("run_id", ""), self._hmi_port,
            f"replay of {self._path.name}: {run.get('title', '')}", page,
            {**plan, "system_file": str(system)}, str(self._path))

    def _page(self, bus: ZenohBus, clock: Clock, folder: Path) -> Hmi | None:
        if not self._hmi_port:
            return None
        run = RunContext(RunPlan(f"replay of {self._path.name}", page=PagePlan(self._hmi_port)),
                         self.known.system, self.document)
        with contextlib.suppress(ValueError, OSError):  # a page without a map shows the rest
            restore(self.summary.files, folder)
            run = replace(run, application=self.known.kind.restored(folder))
        kind = page_of(self.known)
        panels: tuple[Panel, ...] = kind.panels
        with contextlib.suppress(ValueError):  # panels of another version
            panels = kind.given(PAGE, run.system, SYSTEM)["panels"]
        page: type[Hmi] = ReplayPage if kind is Hmi else type("ReplayPage", (ReplayPage, kind), {})
        return page(Context(
            PAGE, 1, clock, shared(bus), {"panels": tuple(
                panel for panel in panels if not panel.stick)}, run,
            topics={topic.key: topic for topic in self.known.topics}))


def page_of(known: RunContents) -> type[Hmi]:
    """Return the class of the operator's page of a system."""
    for node in known.system.nodes:
        with contextlib.suppress(ValueError):
            if node.kind is Kind.NON_CONTROL and issubclass(found := load_class(node.actor), Hmi):
                return found
    return Hmi


def claim_port(port: int) -> None:
    """Refuse the base port of a run to a replay.

    Raises:
        UsageError: a run has this base port.
    """
    living = {process.port for process in find_processes()} | {  # one of both may be restarting
        run.base_port for run in run_info.find_runs() if not run.replay_of}
    if port in living:
        raise UsageError(f"--port {port}: belongs to a run; choose another --port, so that no tool "
                         "takes the replay for a robot")


async def _until(due: float, stop: asyncio.Event) -> bool:
    """Wait until a time of the monotonic clock; return False if `stop` comes first."""
    left_s = due - time.monotonic()
    if left_s > 0.001:
        await pause(stop, left_s)
    return not stop.is_set()


# -- in MuJoCo ---------------------------------------------------------------------------------


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


# -- the verb -----------------------------------------------------------------------------------


_PORTS = (1024, 65535)

TOPICS: dict[str, Any] = {"metavar": "GLOB", "nargs": "+", "action": "extend", "default": []}
"""Fields of an option of patterns of topics, see `matcher`."""

PLAYING = (
    number("--rate", "R", "simulated seconds per second (default: 1)", 1.0),
    option("--topics", **TOPICS, help="play only keys that match a pattern"),
    number("--start", "S", "start at simulated second S of the run"),
    whole("--hmi-port", "PORT", "serve the operator's page on this port of 127.0.0.1", 0),
    flag("--viewer", "show the robot in MuJoCo's viewer"),
    word("--video", "FILE.mp4", "write a video of the robot in MuJoCo instead of playing; "
         "needs the extra `video`"),
    whole("--port", "N", f"base port of the replay (default: {DEFAULT_PORT})", DEFAULT_PORT))
"""Options of a replay."""


async def replay(options: argparse.Namespace) -> int:
    """Play a recording back.

    Play back a recording on a separate bus. Tools such as `rampart topic echo` and
    `rampart status` find it like a run; use --port if a robot runs, too. Orders
    are refused, and no message of the recording reaches a robot.
    A robot with a model in MuJoCo is shown in its viewer, or filmed without a bus:
    --rate is the simulated seconds per second of the video.

    Examples:
      rampart replay run.mcap --hmi-port 8090
      rampart replay run.mcap --viewer
      rampart replay run.mcap --video run.mp4 --rate 4
      rampart replay run.mcap --rate 4 --start 60 --topics 'manager/*'
    """
    _check(options)
    stop = asyncio.Event()
    with stopped_by_signals(stop):
        path = Path(options.file)
        known = Summary(BagReader(path)).keys if options.topics else ()
        chosen: dict[str, Any] = {"start_s": options.start,
                                  "wants": matcher(options.topics, known)}
        if options.video:
            return await _film(RecordedRun(path, **chosen), options, stop)
        player = Replay(path, port=options.port, rate=options.rate, hmi_port=options.hmi_port,
                        report=say, **chosen)
        if player.summary.reader.damage:
            say(f"{options.file}: damaged ({player.summary.reader.damage}); playing the rest")
        with contextlib.ExitStack() as stack:
            if options.viewer:
                viewer = stack.enter_context(contextlib.closing(Viewer(Stage(player))))
                player.viewer = viewer.take
            page = f", page http://127.0.0.1:{options.hmi_port}/" if options.hmi_port else ""
            say(f"playing {options.file} on port {options.port} at rate {options.rate:g}{page}; "
                "ctrl-C ends it")
            await player.run(stop)
    refused = f", {player.refused} of another version left out" if player.refused else ""
    say(f"played {player.played} messages{refused}")
    if not player.played:
        raise NoEffectError("no message was played")
    return 0


async def _film(run: RecordedRun, options: argparse.Namespace, stop: asyncio.Event) -> int:
    """Write a video of a recording, and return the exit code."""
    frames = 0
    with progress() as show, contextlib.closing(
            film(run, Path(options.video), options.rate)) as written:
        for at_s in written:
            frames += 1
            show(f"{options.video}: {at_s:.1f} s of simulated time")
            await asyncio.sleep(0)
            if stop.is_set():
                raise NoEffectError(f"{options.video}: interrupted, not written")
    say(f"{options.video}: {frames} frames, {frames / FRAMES_HZ:.1f} s")
    return 0


def matcher(globs: list[str], known: Iterable[str]) -> Callable[[str], bool]:
    """Return a filter of full keys for the patterns of --topics; without patterns all pass.

    Raises:
        UsageError: a pattern matches no known key.
    """
    keys = [key.removeprefix(f"{ROOT}/") for key in known]
    patterns = [g.removeprefix("/").removeprefix(f"{ROOT}/") for g in globs]
    for pattern in patterns:
        if not any(fnmatch.fnmatchcase(key, pattern) for key in keys):
            families = sorted({key.split("/")[0] for key in keys})
            raise UsageError(f"--topics {pattern}: matches no topic; known: "
                             f"{', '.join(f'{name}/…' for name in families)} "
                             "(`rampart topic list`, `rampart bag info`)")
    if not patterns:
        return lambda _key: True
    return lambda key: any(
        fnmatch.fnmatchcase(key.removeprefix(f"{ROOT}/"), pattern) for pattern in patterns)




def _check(options: argparse.Namespace) -> None:
    between("--rate", options.rate, 0.01, 1000)
    if options.start is not None and not -1e9 < options.start < 1e9:
        raise UsageError(f"--start {options.start:g}: must be a time of the run in seconds")
    if options.video and (options.viewer or options.hmi_port):
        raise UsageError(f"--video {options.video}: plays nothing; not with --viewer or --hmi-port")
    between("--port", options.port, *_PORTS)
    between("--hmi-port", options.hmi_port or _PORTS[0], *_PORTS)
    if options.hmi_port == options.port:
        raise UsageError(f"--hmi-port {options.hmi_port}: is the replay's own --port; choose "
                         "another --hmi-port")
