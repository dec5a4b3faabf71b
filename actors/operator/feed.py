"""Pushes changes of the picture to the open pages, at most 25 times a second, encoded once.

A change is sent in the same turn of the event loop, unless the last frame is younger than
`FRAME_GAP_S`. Pages at the same version share a frame.

*No backlog.* The buffers up to a browser can hold minutes of frames, so a slow page would show the
past. A page therefore reports each frame that it has drawn, and only then gets the newest one. A
client that never reports (a script) is bounded by its socket only. A page that takes nothing for
`SEND_TIMEOUT_S` is disconnected; when it reconnects it gets everything.

While no page is open, nothing runs here.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Awaitable, Callable, Iterator
from typing import Any

import msgspec

from rampart.actors.operator.state import HmiState

FRAME_GAP_S = 0.04
"""Least real seconds between two frames: 20 Hz with room for jitter."""

LOOK_S = 1.0
"""Real seconds between two looks for silent publishers and at the usage of processes."""

SEND_TIMEOUT_S = 5.0


class PageFeed:
    """An open page.

    Attributes:
        version: the newest version that was sent to it.
        news: set when the picture is newer.
        drawn: set while it has nothing left to draw.
    """

    def __init__(self) -> None:
        self.version = 0
        self.news = asyncio.Event()
        self.drawn = asyncio.Event()
        self._answers = False
        self.drawn.set()

    def sends(self, version: int) -> None:
        """Note that a version is sent to it."""
        self.version = version
        self.news.clear()
        if self._answers:  # a script may never report
            self.drawn.clear()

    def seen(self, version: int) -> None:
        """Note that it has drawn a frame, and so all earlier ones."""
        self._answers = True
        if version >= self.version:
            self.drawn.set()


class Feed:
    """Serves the picture to any number of pages.

    Args:
        state: contents of the page.
        now: returns simulated seconds.
        hello: returns the first message to a page.
        look: called once a second while a page is open, before staleness is checked.
    """

    def __init__(self, state: HmiState, now: Callable[[], float], hello: Callable[[], Any],
                 look: Callable[[], None] = lambda: None) -> None:
        self._state = state
        self._now = now
        self._hello = hello
        self._look = look
        self._pages: set[PageFeed] = set()
        self._frames: dict[int, str] = {}
        self._timer: asyncio.TimerHandle | None = None
        self._looker: asyncio.TimerHandle | None = None
        self._last_s = 0.0
        state.picture.on_change = self._changed

    @contextlib.contextmanager
    def page(self) -> Iterator[PageFeed]:
        """Add a page while the context is open."""
        page = PageFeed()
        self._pages.add(page)
        if self._looker is None:
            self._look_around()
        try:
            yield page
        finally:
            self._pages.discard(page)
            if not self._pages:
                for timer in filter(None, (self._timer, self._looker)):
                    timer.cancel()
                self._timer = self._looker = None

    async def push(self, page: PageFeed, send: Callable[[str], Awaitable[None]]) -> None:
        """Send a page its contents until cancelled.

        Raises:
            TimeoutError: the page does not take or draw a frame.
        """
        async with asyncio.timeout(SEND_TIMEOUT_S):
            await send(_encode(self._hello()))
        while True:
            async with asyncio.timeout(SEND_TIMEOUT_S):
                await page.drawn.wait()
                text = self.frame(page.version)
                page.sends(self._state.picture.version)
                await send(text)
            await page.news.wait()

    def frame(self, since: int) -> str:
        """Return the changes since a version, encoded once for all pages."""
        if since not in self._frames:
            picture = self._state.picture
            self._frames[since] = _encode({
                "type": "state", "version": picture.version, "time_s": round(self._now(), 3),
                **picture.changes(since)})
        return self._frames[since]

    def _changed(self) -> None:
        self._frames.clear()
        if self._pages and self._timer is None:
            loop = asyncio.get_running_loop()
            self._timer = loop.call_at(max(self._last_s + FRAME_GAP_S, loop.time()), self._wake)

    def _wake(self) -> None:
        self._timer = None
        self._last_s = asyncio.get_running_loop().time()
        for page in self._pages:
            page.news.set()

    def _look_around(self) -> None:
        self._look()
        self._state.grow_old(self._now())
        self._frames.clear()  # they contain the time
        self._wake()
        self._looker = asyncio.get_running_loop().call_later(LOOK_S, self._look_around)


def _encode(data: Any) -> str:
    return msgspec.json.encode(data).decode()
