"""The screen of `rampart top`: messages, processes, drawing, keys."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import math
import shutil
import sys

from rich.console import Console, Group
from rich.live import Live

from rampart.actors.bus import run_info
from rampart.cli.following import LOOK_S, Watch, is_over, sessions, stopped_by_signals
from rampart.cli.look import top_view
from rampart.cli.output import print_json, say
from rampart.cli.session import Session, pause
from rampart.cli.terminal import END, keys

_ONCE_S = 2.0
"""Simulated seconds in which all states arrive, and the slowest rates can be measured."""

_SCROLL = {"up": -1, "down": 1, "k": -1, "j": 1}


async def top(options: argparse.Namespace) -> int:
    """Show the run."""
    stop = asyncio.Event()
    live = not (options.once or options.json) and sys.stdout.isatty()
    with stopped_by_signals(stop):
        async with contextlib.aclosing(
                sessions(options.port, stop, follow=options.follow)) as found:
            async for session in found:
                screen = _Screen(session)
                if not live:
                    return await _once(screen, options, stop)
                await _live(screen, session, stop)
                if stop.is_set():
                    break
                say(f"the run has ended: {session.run.title} (port {session.run.base_port})")
                if options.follow:
                    say("waiting for the next one; Ctrl-C ends")
    return 0


class _Screen:
    """One run, and the settings of its view."""

    def __init__(self, session: Session) -> None:
        self.watch = Watch(session)
        self.skip = 0
        self.by_cpu = False

    def frame(self) -> top_view.Frame:
        """Take a sample, and return the data of one screen."""
        run, now_s, used = self.watch.session.run, self.watch.look(), self.watch.used
        run = run_info.ask(run.base_port) or run
        return top_view.Frame(run.title, run.base_port, run.rate, now_s, self.watch.picture,
                              used["nodes"], used["guards"], self.skip, self.by_cpu,
                              run.recording_in_words)

    def press(self, key: str, stop: asyncio.Event) -> None:
        """Handle a key."""
        if key in {"q", "Q", END}:
            stop.set()
        elif key == "c":
            self.by_cpu = not self.by_cpu
        elif key in _SCROLL:
            self.skip = max(0, self.skip + _SCROLL[key])


async def _once(screen: _Screen, options: argparse.Namespace, stop: asyncio.Event) -> int:
    frame = screen.frame()
    for _ in range(math.ceil(screen.watch.session.real_s(_ONCE_S) / LOOK_S)):
        await pause(stop, LOOK_S)
        frame = screen.frame()
    if options.json:
        print_json(top_view.picture_json(frame))
        return 0
    columns, _ = shutil.get_terminal_size((100, 60))
    rows = 14 + len(frame.usage) + len(frame.guards)
    console = Console(width=columns)
    for line in top_view.lines(frame, columns, rows)[:-1]:
        console.print(line)
    return 0


async def _live(screen: _Screen, session: Session, stop: asyncio.Event) -> None:
    """Show a run until it ends or the user quits."""
    console = Console()
    with keys(lambda key: screen.press(key, stop)), Live(
            console=console, screen=True, auto_refresh=False) as live:
        while not stop.is_set() and not is_over(session.run):
            width, height = console.size
            live.update(Group(*top_view.lines(screen.frame(), width, height)), refresh=True)
            await pause(stop, LOOK_S)
