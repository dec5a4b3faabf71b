"""Plays a recording back onto a bus of its own, where tools and an operator's page can read it.

A replay must never reach a robot. It is a router of its own, on a socket in a folder of its own;
nodes of a run know only the routers in the folder of their run. Tools find it as they find a run,
and are told that it is none: they give it no orders, and prefer a run to it.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
import tempfile
import time
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Iterator
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import tomli_w

from rampart.actors.bus import run_folder, run_info
from rampart.actors.bus.bus import BusError, shared
from rampart.actors.bus.envelope import UNREADABLE
from rampart.actors.bus.messages import Message
from rampart.actors.bus.recorder_connection import RecorderConnection
from rampart.actors.bus.topic import Qos, Topic
from rampart.actors.bus.zenoh_bus import ZenohBus
from rampart.actors.bus.zenoh_session import endpoint
from rampart.actors.operator.hmi import Hmi
from rampart.actors.operator.panels import Panel
from rampart.actors.recording.bag_reader import BagReader, Summary, key_of
from rampart.actors.recording.message_form import Forms, header_of, renumbered
from rampart.actors.recording.run_documents import NOT_CHOSEN, SYSTEM, Known, restore
from rampart.actors.runtime.actor import Context
from rampart.actors.runtime.clock import Clock
from rampart.actors.runtime.run_context import NO_SYSTEM, RunContext
from rampart.actors.runtime.run_plan import RunPlan
from rampart.actors.supervision.process_title import find_processes
from rampart.actors.system.members import application_class, load_class
from rampart.actors.web.page_plan import PagePlan
from rampart.cli.output import UsageError, refusing
from rampart.cli.session import pause
from rampart.manager.spec.schema import Kind
from rampart.manager.spec.specification import check_document, read_document

DEFAULT_PORT = 7400
PAGE = "replay_page"
"""Name of the operator's page of a replay: not that of the page of which there is a recording."""

GAP_S = 0.1
"""Simulated seconds between two laps."""

_STRANGE: Topic[Any] = Topic("", Message, Qos.SENSOR, 0, "", "What was recorded on no topic's key.")
_YIELD_EVERY = 50
_LINGER_S = 0.3


class Due(NamedTuple):
    """A message to be played: in which lap, at which simulated time, and as it was recorded."""

    lap: int
    at_s: float
    key: str
    payload: bytes


class ReplayPage(Hmi):
    """The operator's page on a replay: it shows everything, and nothing can be asked of it."""

    badge = "replay"
    refuses = "This is a replay: there is no robot to obey"

    def _look(self) -> None:
        """Measure nothing: the recorded process numbers may be anybody's today."""


class RecordedRun:
    """A recording of a run, as far as it is to be played.

    Args:
        path: of the recording.
        loop: begin again at the end.
        start_s: simulated time at which to begin; None for the beginning.
        wants: whether a full key is played.

    Attributes:
        summary: of the recording.
        known: its system.
        refused: messages of another version, which are not played.

    Raises:
        BagError: the file cannot be read.
        UsageError: it is not a recording of a run, or there is nothing to play.
    """

    def __init__(self, path: Path, *, loop: bool = False, start_s: float | None = None,
                 wants: Callable[[str], bool] = lambda _key: True) -> None:
        self.summary = summary = Summary(BagReader(path))
        self.document, self.known = recorded_system(summary)
        self.forms = Forms(self.known.topics)
        self.refused = 0
        self._path = path
        self._loop = loop
        self._wants = wants
        if not summary.reader.is_recording:
            raise UsageError(f"{path}: an MCAP file of {summary.reader.library or 'others'}, not a "
                             "recording of a run: nothing in it can be played onto the bus")
        if not any(wants(key) for key in summary.keys) or summary.first_ns is None:
            raise UsageError(f"{path}: no message to play")
        first_s = summary.first_ns / 1e9 + summary.time_zero_s
        last_s = summary.last_ns / 1e9 + summary.time_zero_s
        self._lap_s = last_s - first_s + GAP_S
        self._start_s = first_s if start_s is None else max(start_s, first_s)
        if self._start_s > last_s:
            raise UsageError(f"--start {start_s:g}: the recording goes from {first_s:.1f} to "
                             f"{last_s:.1f} simulated seconds")

    def messages(self) -> Iterator[Due | None]:
        """Yield what is to be played, lap by lap; None for each message that is not."""
        zero_s = self.summary.time_zero_s
        reader = BagReader(self._path)  # the summary's is asked for its channels meanwhile
        for lap in count() if self._loop else range(1):
            is_empty = True
            for channel, message in reader.messages():
                at_s = message.log_time / 1e9 + zero_s + lap * self._lap_s
                key, payload = key_of(channel), None
                if key is not None and at_s >= self._start_s and self._wants(key):
                    try:
                        payload = self.forms.of(key).payload(message.data)
                    except (ValueError, RecursionError):  # of another version of this program
                        self.refused += 1
                is_empty &= payload is None
                yield None if key is None or payload is None else Due(lap, at_s, key, payload)
            if lap and is_empty:  # in the first lap all may lie before the start
                return


class Replay(RecordedRun):
    """A recorded run that is played back onto a bus. Use: `run`, once.

    Args:
        path: of the recording.
        port: number under which tools find it.
        rate: simulated seconds per second.
        hmi_port: port of an operator's page; 0 for none.
        said: told, in a line, what happens.
        chosen: as of `RecordedRun`.

    Attributes:
        viewer: takes key and payload of what is played, and returns whether to go on.

    Raises:
        BagError: as of `RecordedRun`.
        UsageError: as of `RecordedRun`, or a port is taken.
    """

    def __init__(self, path: Path, *, port: int = DEFAULT_PORT, rate: float = 1.0,
                 hmi_port: int = 0,
                 said: Callable[[str], None] = lambda _line: None, **chosen: Any) -> None:
        super().__init__(path, **chosen)
        self.played = 0
        self._port = port
        self._rate = rate
        self._hmi_port = hmi_port
        self.viewer: Callable[[str, bytes], bool] = lambda _key, _payload: True
        self._said = said
        self._sockets = ""
        self._lives: dict[str, int] = {}
        claim_port(port)
        if hmi_port:
            try:
                socket.create_server(("127.0.0.1", hmi_port)).close()
            except OSError:
                raise UsageError(f"--hmi-port {hmi_port}: in use; choose another --hmi-port"
                                 ) from None

    async def run(self, stop: asyncio.Event, delay_s: float = 0.0) -> None:
        """Play to the end, or until `stop` is set; with a page or in a loop there is no end.

        Args:
            stop: ends it.
            delay_s: real seconds before the first message, for readers to come.

        Raises:
            UsageError: the number is taken, or there is no place for a socket.
        """
        async with contextlib.aclosing(self._until_stopped(stop)) as messages:
            due = await anext(messages, None)  # may lie deep in the file: no clock runs yet
            clock = Clock(time.monotonic() + delay_s - self._start_s / self._rate, self._rate)
            async with self._on_the_bus(clock) as (bus, page):
                while due and await _until(clock.source_time(due.at_s), stop):
                    self._send(bus, due)
                    if not self.viewer(due.key, due.payload):
                        stop.set()
                    due = await anext(messages, None)
                if page and not page.done() and not stop.is_set():
                    self._said("the recording is over; the page stays, ctrl-C ends it")
                    stopped = asyncio.create_task(stop.wait())
                    await asyncio.wait((page, stopped), return_when=asyncio.FIRST_COMPLETED)
                    stopped.cancel()
                await asyncio.sleep(_LINGER_S)  # what was sent last is still under way

    @contextlib.asynccontextmanager
    async def _on_the_bus(self, clock: Clock
                          ) -> AsyncIterator[tuple[ZenohBus, asyncio.Task[None] | None]]:
        """Have a bus that tools find, and the page's task if there is a page."""
        with contextlib.ExitStack() as stack:
            try:
                self._sockets = run_folder.make(self._port, os.getpid())
            except OSError as error:
                raise UsageError(f"no folder for a socket: {error}") from None
            stack.callback(run_folder.remove, self._sockets)
            folder = Path(stack.enter_context(
                tempfile.TemporaryDirectory(prefix="rampart-replay-")))
            stack.enter_context(self._answering(clock, folder))
            bus = ZenohBus("", [], [endpoint(self._sockets, run_info.REPLAY)],
                           RecorderConnection(self._port))
            with refusing(BusError):
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
        """Yield what is to be played, until `stop`; other tasks get their turn meanwhile."""
        for number, due in enumerate(self.messages()):
            if number % _YIELD_EVERY == 0:
                await asyncio.sleep(0)
            if stop.is_set():
                return
            if due is not None:
                yield due

    def _send(self, bus: ZenohBus, due: Due) -> None:
        """Send a message; in later laps as of later incarnations, or readers drop it as a copy."""
        payload = due.payload
        header = header_of(payload) if self._loop else None
        if header is not None and due.lap == 0:
            self._lives[header.source] = max(
                header.incarnation, self._lives.get(header.source, 0))
        elif header is not None:
            lives = due.lap * self._lives.get(header.source, header.incarnation)
            payload = renumbered(payload, lives, due.lap * self._lap_s)
        bus.publish(self.forms.of(due.key).topic or _STRANGE, due.key, payload)
        self.played += 1

    def _page_ended(self, page: asyncio.Task[None]) -> None:
        if not page.cancelled() and (error := page.exception()) is not None:
            words = " ".join(str(error).split())
            self._said(f"the page has ended: {type(error).__name__}: {words}")

    # -- being found ----------------------------------------------------------------------------

    @contextlib.contextmanager
    def _answering(self, clock: Clock, folder: Path) -> Iterator[None]:
        """Tell tools of this replay, as a launcher tells them of its run."""
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
        told = {name: value for name, value in run.items() if name not in NOT_CHOSEN}
        return run_info.RunInfo(
            os.getpid(), self._port, self._rate, clock.source_time(0.0),
            str(system) if system.exists() else "", self._sockets, tuple(nodes or ["replay"]),
            run.get("run_id", ""), self._hmi_port,
            f"replay of {self._path.name}: {run.get('title', '')}", page,
            {**told, "system_file": str(system)}, str(self._path))

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


def recorded_system(summary: Summary) -> tuple[dict[str, Any], Known]:
    """Return the system of a recording, as TOML and read; what cannot be read is left out."""
    document: dict[str, Any] = {}
    found = NO_SYSTEM
    with contextlib.suppress(StopIteration, ValueError):
        text = next(data for name, _, data in summary.files if name == SYSTEM).decode()
        document = read_document(text, SYSTEM)
        found = check_document(document, SYSTEM)
    try:
        return document, Known(found, application_class(found))
    except ValueError:  # an application that is not installed here
        return document, Known(found)


def page_of(known: Known) -> type[Hmi]:
    """Return the class of the operator's page of a system."""
    for node in known.system.nodes:
        with contextlib.suppress(ValueError):
            if node.kind is Kind.NON_CONTROL and issubclass(found := load_class(node.actor), Hmi):
                return found
    return Hmi


def claim_port(port: int) -> None:
    """Make sure that a replay is not taken for a run that lives.

    Raises:
        UsageError: a run has that number.
    """
    living = {process.port for process in find_processes()} | {  # either may be dead just now
        run.base_port for run in run_info.find_runs() if not run.replay_of}
    if port in living:
        raise UsageError(f"--port {port}: belongs to a run; a replay must never be taken for a "
                         "living robot, choose another --port")


async def _until(due: float, stop: asyncio.Event) -> bool:
    """Wait until a reading of the monotonic clock; False if it is to stop."""
    left_s = due - time.monotonic()
    if left_s > 0.001:
        await pause(stop, left_s)
    return not stop.is_set()
