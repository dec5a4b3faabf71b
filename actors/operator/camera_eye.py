"""Gets pictures from a renderer, a program of its own that is started when a page asks for one.

The renderer, which the robot's page names, runs as long as pictures are asked for and `IDLE_S`
longer. All pages share its pictures, `PERIOD_S` apart. It may fail, hang or be killed: then the
page is told why, and the next try is made after `RETRY_S`. Nothing else waits for it, and it costs
nothing while no page asks.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import struct
import sys
from asyncio.subprocess import PIPE, Process
from collections.abc import Callable, Sequence
from typing import Any

import msgspec

PERIOD_S = 0.2
"""Real seconds between two pictures."""

IDLE_S = 4.0
START_S = 30.0
"""Loading and the first picture, on a busy machine."""

PICTURE_S = 4.0
RETRY_S = 10.0
MAX_BYTES = 4_000_000

_ENVIRONMENT = {"MUJOCO_GL": "egl", "LP_NUM_THREADS": "1"}
"""Renders without a screen; and where Mesa renders in software, it leaves the other cores alone."""


class CameraError(Exception):
    """There is no picture; the text says why."""


def renderer(module: str) -> tuple[str, ...]:
    """Return the command of a renderer that is a Python module."""
    return sys.executable, "-m", module


class CameraEye:
    """Pictures of what the controller believes.

    Args:
        command: the renderer's command line.
        order: the line that it is given first.
        view: returns the line for the next picture, or None while there is nothing to show.
    """

    def __init__(self, command: Sequence[str], order: Any, view: Callable[[], Any]) -> None:
        self._command = command
        self._order = order
        self._view = view
        self._process: Process | None = None
        self._lock = asyncio.Lock()
        self._picture = b""
        self._failure = ""
        self._until_s = 0.0  # so long holds the picture, or the failure
        self._idle: asyncio.TimerHandle | None = None
        self._ending: set[asyncio.Task[int]] = set()

    async def picture(self) -> bytes:
        """Return a JPEG that is younger than `PERIOD_S`.

        Raises:
            CameraError: there is none.
        """
        if self._idle is not None:
            self._idle.cancel()
        try:
            return await self._newest()
        finally:
            if self._idle is not None:
                self._idle.cancel()
            self._idle = asyncio.get_running_loop().call_later(IDLE_S, self._rest)

    async def _newest(self) -> bytes:
        loop = asyncio.get_running_loop()
        async with self._lock:  # those who ask meanwhile get the same picture
            if loop.time() >= self._until_s:
                await self._renew()
            if self._failure:
                raise CameraError(self._failure)
            return self._picture

    async def _renew(self) -> None:
        view = self._view()
        if view is None:
            raise CameraError("the robot's pose is not known")
        self._failure, lasts_s = "", PERIOD_S
        try:
            self._picture = await self._take(view)
        except asyncio.CancelledError:
            self.close()  # it may be in the middle of a picture
            raise
        except (TimeoutError, OSError, CameraError) as error:
            self._failure, lasts_s = str(error) or "the renderer does not answer", RETRY_S
            self.close()
        self._until_s = asyncio.get_running_loop().time() + lasts_s

    def _rest(self) -> None:
        if not self._lock.locked():  # else a page looks, and will set the timer again
            self.close()

    def close(self) -> None:
        """End the renderer, if there is one; the next picture starts another."""
        process, self._process = self._process, None
        if process is not None and process.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                process.kill()
            task = asyncio.get_running_loop().create_task(process.wait())
            self._ending.add(task)
            task.add_done_callback(self._ending.discard)

    async def ended(self) -> None:
        """Wait until all renderers that were closed have ended."""
        await asyncio.gather(*self._ending)

    async def _take(self, view: Any) -> bytes:
        process = self._process
        fresh = process is None or process.returncode is not None
        async with asyncio.timeout(START_S if fresh else PICTURE_S):
            if process is None or fresh:
                self._process = process = await asyncio.create_subprocess_exec(
                    *self._command, stdin=PIPE, stdout=PIPE, stderr=PIPE,
                    env={**_ENVIRONMENT, **os.environ})
            ask, answer, complaint = process.stdin, process.stdout, process.stderr
            if ask is None or answer is None or complaint is None:
                raise CameraError("the renderer has no pipes")
            try:
                for line in [self._order, view] if fresh else [view]:
                    ask.write(msgspec.json.encode(line) + b"\n")
                await ask.drain()
                size, = struct.unpack(">I", await answer.readexactly(4))
                if size > MAX_BYTES:
                    raise CameraError(f"the renderer sends a picture of {size} bytes")
                return await answer.readexactly(size)
            except (asyncio.IncompleteReadError, ConnectionError):
                raise CameraError(await _last_words(complaint)) from None


async def _last_words(complaint: asyncio.StreamReader) -> str:
    """Return why a renderer that has ended could not go on: the last line that it said."""
    words = b""
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(1.0):
            words = await complaint.read(65536)
    lines = words.decode(errors="replace").strip().splitlines()
    return f"this machine cannot render: {lines[-1][:200]}" if lines else "the renderer died"
