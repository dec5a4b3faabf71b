"""Tools that follow a run to its end, and then the next one."""

from __future__ import annotations

import asyncio
import contextlib
import signal
from collections.abc import AsyncGenerator, Iterator
from typing import Any

from rampart.actors.bus.run_info import RunInfo, find_runs
from rampart.actors.bus.topic import Topic
from rampart.actors.ftm import topics
from rampart.actors.operator.processes import ProcessObserver
from rampart.actors.supervision.process_title import process_state
from rampart.actors.system.topics import declared_topics, own_topics
from rampart.cli import systems
from rampart.cli.output import NoEffectError, UsageError, warn
from rampart.cli.run_picture import DECODED, RunPicture
from rampart.cli.session import Session, connect, pause

LOOK_S = 0.25
"""Real seconds between two checks whether a run has ended or begun."""

_AGAIN_S = 5.0

_USAGE_EVERY = 4
"""Samples for each look at /proc, whose clock ticks 100 times per second."""


def is_over(run: RunInfo) -> bool:
    """Whether the launcher of a run has ended; its nodes end with it."""
    return process_state(run.pid) in {"X", "Z"}


async def wait_for_run(port: int | None, stop: asyncio.Event) -> bool:
    """Wait for a run to join; return False if `stop` comes first."""
    while not stop.is_set():
        runs = await asyncio.to_thread(find_runs)
        if any(port in {None, run.base_port} for run in runs):
            return True
        await pause(stop, LOOK_S)
    return False


async def sessions(port: int | None, stop: asyncio.Event) -> AsyncGenerator[Session, None]:
    """Wait for a run and yield its session, and that of each later run.

    The body of the caller's loop ends when `is_over` or `stop` is true.

    Args:
        port: base port of the run, by `--run`; None for the only one.
        stop: ends the iteration.

    Raises:
        UsageError: there are several runs, and no port.
    """
    while await wait_for_run(port, stop):
        try:
            async with connect(port) as session:
                yield session
        except UsageError as error:
            if len(find_runs()) > 1:
                raise UsageError(str(error).replace("--port", "--run")) from None
        except NoEffectError as error:
            warn(str(error))
            await pause(stop, _AGAIN_S)


@contextlib.contextmanager
def stopped_by_signals(stop: asyncio.Event) -> Iterator[None]:
    """Set an event on SIGINT, SIGTERM and SIGHUP."""
    loop = asyncio.get_running_loop()
    numbers = [signal.SIGINT, signal.SIGTERM]
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:  # as it is under nohup
        numbers.append(signal.SIGHUP)
    for number in numbers:
        loop.add_signal_handler(number, stop.set)
    try:
        yield
    finally:
        for number in numbers:
            loop.remove_signal_handler(number)


def draw(session: Session, picture: RunPicture) -> None:
    """Keep all messages of a session in a picture, with the lines of its robot."""
    clock = session.clock

    def subscribe(topic: Topic[Any]) -> None:
        if topic in (*DECODED, *picture.lines.read):
            session.listen(topic, lambda _key, header, body: picture.heard(
                topic, header, body, clock.now()))
        else:
            session.overhear(topic, lambda _key, _load: picture.count(topic))

    known: tuple[Topic[Any], ...] = topics.ALL
    try:
        spec = systems.load(session.run.system_file)
        picture.lines = systems.lines_of(spec)
        known = declared_topics(spec)
        known += own_topics(spec)
    except ValueError as error:  # for example a run from another folder
        warn(f"{error}; only topics of the engine are counted")
    for topic in known:
        subscribe(topic)


class Watch:
    """Messages and processor use of one run.

    Attributes:
        session: the connection to the run.
        picture: the messages.
        used: last result of `ProcessObserver.look`; empty for a replay, whose process numbers may
            belong to other processes today.
    """

    def __init__(self, session: Session) -> None:
        self.session = session
        self.picture = RunPicture()
        self.used: dict[str, Any] = {"nodes": {}, "guards": ()}
        self._processes = ProcessObserver(
            session.run.base_port, session.run.pid, session.run.host)
        self._looks = 0
        draw(session, self.picture)

    def look(self) -> float:
        """Take a sample, look at the processes if due, and return the simulated time."""
        now_s = self.session.clock.now()
        self.picture.sample(now_s)
        table = self.picture.latest(topics.NODES)
        if table is not None and not self.session.run.replay_of:
            if self._looks % _USAGE_EVERY == 0:
                self.used = self._processes.look(table)
            self._looks += 1
        return now_s
