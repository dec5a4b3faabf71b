"""Pictures from a renderer, a separate program that runs while a page requests pictures.

The robot's page names the renderer. It ends `IDLE_S` after the last request. All pages share its
pictures, `PERIOD_S` apart. If it fails, hangs or is killed, the page shows the reason, and the next
try is `RETRY_S` later. Nothing else waits for it.
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
"""Real seconds to load and to render the first picture, on a busy machine."""

PICTURE_S = 4.0
RETRY_S = 10.0
MAX_BYTES = 4_000_000

_ENVIRONMENT = {"MUJOCO_GL": "egl", "LP_NUM_THREADS": "1"}
"""Renders without a screen, and with one thread if Mesa renders in software."""


class CameraError(Exception):
    """There is no picture; the text is the reason."""


def renderer(module: str) -> tuple[str, ...]:
    """Return the command of a renderer that is a Python module."""
    return sys.executable, "-m", module


class CameraEye:
    """Pictures of the robot as the controller believes it to be.

    Args:
        command: the renderer's command line.
        order: first line of its input.
        view: returns the line for the next picture, or None while the pose is not known.
    """

    def __init__(self, command: Sequence[str], order: Any, view: Callable[[], Any]) -> None:
        self._command = command
        self._order = order
        self._view = view
        self._process: Process | None = None
        self._lock = asyncio.Lock()
        self._picture = b""
        self._failure = ""
        self._until_s = 0.0  # end of validity of the picture, or of the failure
        self._idle: asyncio.TimerHandle | None = None
        self._ending: set[asyncio.Task[int]] = set()

    async def picture(self) -> bytes:
        """Return a JPEG that is younger than `PERIOD_S`.

        Raises:
            CameraError: there is no picture.
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
        async with self._lock:  # simultaneous requests get the same picture
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
            self.close()  # its output may end within a picture
            raise
        except (TimeoutError, OSError, CameraError) as error:
            self._failure, lasts_s = str(error) or "the renderer does not answer", RETRY_S
            self.close()
        self._until_s = asyncio.get_running_loop().time() + lasts_s

    def _rest(self) -> None:
        if not self._lock.locked():  # otherwise a request is running, and sets the timer again
            self.close()

    def close(self) -> None:
        """Kill the renderer, if there is one; the next picture starts another one."""
        process, self._process = self._process, None
        if process is not None and process.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                process.kill()
            task = asyncio.get_running_loop().create_task(process.wait())
            self._ending.add(task)
            task.add_done_callback(self._ending.discard)

    async def ended(self) -> None:
        """Wait until all closed renderers have ended."""
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
                raise CameraError(await _last_line(complaint)) from None


async def _last_line(complaint: asyncio.StreamReader) -> str:
    """Return why a renderer has ended: the last line of its stderr."""
    text = b""
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(1.0):
            text = await complaint.read(65536)
    lines = text.decode(errors="replace").strip().splitlines()
    return f"this machine cannot render: {lines[-1][:200]}" if lines else "the renderer died"
