"""Pushes the picture to the open pages: what changed, at most 25 times a second, encoded once.

A change is on its way in the same turn of the event loop, unless the last frame is younger than
`FRAME_GAP_S`. Pages at the same version share a frame.

*No backlog.* The buffers between here and a browser hold minutes of frames, so that a page that
cannot keep up would show the past. A page therefore reports which frame it has drawn, and has at
most `IN_FLIGHT` frames that it has not; with its answer it gets the newest. A client that never
answers (a script) is bounded by its socket alone. A page that takes nothing for `SEND_TIMEOUT_S` is
disconnected; it may come back and is given everything.

Nothing here costs anything while no page is open.
"""

from __future__ import annotations

import asyncio
import contextlib
import re
from collections.abc import Awaitable, Callable, Iterator
from typing import Any

import msgspec

from rampart.actors.operator.state import HmiState

FRAME_GAP_S = 0.04
"""Real seconds between two frames at least: 20 Hz, with room for jitter."""

LOOK_S = 1.0
"""Between two looks at what no message carries: silent publishers, what the processes use."""

SEND_TIMEOUT_S = 5.0
IN_FLIGHT = 2

_SEEN = re.compile(rb'\{"type":"seen","version":(\d{1,33})\}')


class PageFeed:
    """An open page: which versions it was sent, and which of them it has drawn.

    Attributes:
        version: the newest that it was sent.
    """

    def __init__(self) -> None:
        self.version = 0
        self.news = asyncio.Event()
        self.drawn = asyncio.Event()
        self._on_the_way: list[int] = []
        self._answers = False
        self.drawn.set()

    def sends(self, version: int) -> None:
        """Take note of what it is being sent."""
        self.version = version
        self.news.clear()
        self._on_the_way = [*self._on_the_way, version][-IN_FLIGHT:]  # it may never answer
        if self._answers and len(self._on_the_way) == IN_FLIGHT:
            self.drawn.clear()

    def seen(self, version: int) -> None:
        """Take note that it has drawn a frame, and with it all before."""
        self._answers = True
        self._on_the_way = [v for v in self._on_the_way if v > version]
        self.drawn.set()


class Feed:
    """Serves the picture to any number of pages.

    Args:
        state: what is shown.
        now: the present simulated time.
        hello: what a page is told once.
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
        """Have a page among those that are sent news."""
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
        """Send a page what it should show, until cancelled.

        Raises:
            TimeoutError: it does not take it, or does not draw it.
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

    def heard(self, page: PageFeed, text: str | bytes | None) -> bool:
        """Take note if a message reports a frame as drawn; return whether it does."""
        raw = text.encode(errors="replace") if isinstance(text, str) else text or b""
        if found := _SEEN.fullmatch(raw):
            page.seen(int(found[1]))
        return found is not None

    def frame(self, since: int) -> str:
        """Return what changed since a version; encoded once for all pages that are there."""
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
            self._timer = loop.call_at(max(self._last_s + FRAME_GAP_S, loop.time()), self._tell)

    def _tell(self) -> None:
        self._timer = None
        self._last_s = asyncio.get_running_loop().time()
        for page in self._pages:
            page.news.set()

    def _look_around(self) -> None:
        self._look()
        self._state.grow_old(self._now())
        self._frames.clear()  # the time has gone on
        self._tell()
        self._looker = asyncio.get_running_loop().call_later(LOOK_S, self._look_around)


def _encode(data: Any) -> str:
    return msgspec.json.encode(data).decode()
