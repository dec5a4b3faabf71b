"""The screen of `rampart top`: listens to the run, looks at its processes, draws, takes keys."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import math
import shutil
import sys
from typing import Any

from rich.console import Console, Group
from rich.live import Live

from rampart.actors.ftm import topics
from rampart.actors.operator.processes import ProcessObserver
from rampart.cli.following import LOOK_S, draw, is_over, sessions, stopped_by_signals
from rampart.cli.look import top_view
from rampart.cli.output import print_json, say
from rampart.cli.run_picture import RunPicture
from rampart.cli.session import Session, pause
from rampart.cli.terminal import END, keys

_ONCE_S = 2.0
"""Simulated seconds in which all states are heard, and the rates of the slowest topics shown."""

_USAGE_EVERY = 4
"""Refreshes between two looks at /proc: its clock ticks 100 times a second."""

_SCROLL = {"up": -1, "down": 1, "k": -1, "j": 1}


async def top(options: argparse.Namespace) -> int:
    """Show the run."""
    stop = asyncio.Event()
    live = not (options.once or options.json) and sys.stdout.isatty()
    with stopped_by_signals(stop):
        async with contextlib.aclosing(
                sessions(options.port, stop, follow=options.follow)) as found:
            async for session in found:
                watch = _Watch(session)
                if not live:
                    return await _once(watch, options, stop)
                await _live(watch, stop)
                if stop.is_set():
                    break
                say(f"the run has ended: {session.run.title} (port {session.run.base_port})")
                if options.follow:
                    say("waiting for the next one; Ctrl-C ends")
    return 0


class _Watch:
    """What is heard in one run, and how it is looked at."""

    def __init__(self, session: Session) -> None:
        self.session = session
        self.picture = RunPicture()
        self.skip = 0
        self.by_cpu = False
        self._processes = ProcessObserver(session.run.base_port, session.run.pid)
        self._looks = 0
        self._used: dict[str, Any] = {"nodes": {}, "guards": ()}
        draw(session, self.picture)

    def frame(self) -> top_view.Frame:
        """Look, and return what is to be shown."""
        session = self.session
        now_s = session.clock.now()
        self.picture.sample(now_s)
        table = self.picture.latest(topics.NODES)
        # Before, nobody knows whom to look at; on a replay the numbers may be anybody's today.
        if table is not None and not session.run.replay_of:
            if self._looks % _USAGE_EVERY == 0:
                self._used = self._processes.look(table)
            self._looks += 1
        return top_view.Frame(
            session.run.title, session.run.base_port, session.run.rate, now_s, self.picture,
            self._used["nodes"], self._used["guards"], self.skip, self.by_cpu)


async def _once(watch: _Watch, options: argparse.Namespace, stop: asyncio.Event) -> int:
    frame = watch.frame()
    for _ in range(math.ceil(watch.session.real_s(_ONCE_S) / LOOK_S)):
        await pause(stop, LOOK_S)
        frame = watch.frame()
    if options.json:
        print_json(top_view.picture_json(frame))
        return 0
    columns, _ = shutil.get_terminal_size((100, 60))
    rows = 14 + len(frame.usage) + len(frame.guards)
    console = Console(width=columns)
    for line in top_view.lines(frame, columns, rows)[:-1]:
        console.print(line)
    return 0


async def _live(watch: _Watch, stop: asyncio.Event) -> None:
    """Show a run until it ends or the user has seen enough."""
    console = Console()
    with keys(lambda key: _press(watch, key, stop)), Live(
            console=console, screen=True, auto_refresh=False) as live:
        while not stop.is_set() and not is_over(watch.session.run):
            width, height = console.size
            live.update(Group(*top_view.lines(watch.frame(), width, height)), refresh=True)
            await pause(stop, LOOK_S)


def _press(watch: _Watch, key: str, stop: asyncio.Event) -> None:
    if key in {"q", "Q", END}:
        stop.set()
    elif key == "c":
        watch.by_cpu = not watch.by_cpu
    elif key in _SCROLL:
        watch.skip = max(0, watch.skip + _SCROLL[key])
