"""Pushes the picture to the open pages: what changed, at most 25 times a second, encoded once.

A change that matters is on its way in the same turn of the event loop, unless the last frame is
younger than `FRAME_GAP_S`; what is not urgent rides along. Pages at the same version share a frame.

*No backlog.* The buffers between here and a browser hold minutes of frames, so that a page that
cannot keep up would show the past. A page therefore says which frame it has drawn, and has at most
`IN_FLIGHT` frames that it has not; when it answers it gets the newest. A client that never answers
(a script) is bounded by its socket alone. One that takes nothing for `SEND_TIMEOUT_S` is
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

RIDE_S = 0.1
"""What is not urgent waits so long for company at most."""

LOOK_S = 1.0
"""Between two looks at what no message says: who has fallen silent, what the processes use."""

SEND_TIMEOUT_S = 5.0
IN_FLIGHT = 2

_SEEN = re.compile(rb'\{"type":"seen","version":(\d{1,33})\}')


class PageFeed:
    """What the feed knows of one open page."""

    def __init__(self) -> None:
        self.version = 0
        self.due = False
        self._sent: list[int] = []
        self._answers = False
        self._wake = asyncio.Event()

    def may_have_more(self) -> bool:
        """Tell whether it has drawn enough of what it was sent to be sent more."""
        return not self._answers or len(self._sent) < IN_FLIGHT

    def sends(self, version: int) -> None:
        """Take note of what it is being sent."""
        self.version, self.due = version, False
        self._sent = [*self._sent, version][-2 * IN_FLIGHT:]  # bounded: it may never answer

    def seen(self, version: int) -> None:
        """Hear that it has drawn a frame, and with it all before."""
        self._answers = True
        self._sent = [v for v in self._sent if v > version]
        self._wake.set()

    def tell(self) -> None:
        """Tell it that there is news."""
        self.due = True
        self._wake.set()

    async def wait(self) -> None:
        """Wait until it was told something, or has answered."""
        self._wake.clear()
        await self._wake.wait()


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
        """Have a page among those that are told of news."""
        page = PageFeed()
        self._pages.add(page)
        if self._looker is None:
            self._look_round()
        try:
            yield page
        finally:
            self._pages.discard(page)
            if not self._pages:
                self._rest()

    async def push(self, page: PageFeed, send: Callable[[str], Awaitable[None]]) -> None:
        """Send a page what it should show, until cancelled.

        Raises:
            TimeoutError: it does not take it, or does not draw it.
        """
        async with asyncio.timeout(SEND_TIMEOUT_S):
            await send(_encode(self._hello()))
        while True:
            async with asyncio.timeout(SEND_TIMEOUT_S):
                while not page.may_have_more():
                    await page.wait()
                text = self.frame(page.version)
                page.sends(self._state.picture.version)
                await send(text)
            while not page.due:
                await page.wait()

    def heard(self, page: PageFeed, text: str | bytes | None) -> bool:
        """Take note if a message says that a frame was drawn; tell whether it was such a one."""
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

    # -- when -----------------------------------------------------------------------------------

    def _changed(self, urgent: bool) -> None:
        self._frames.clear()
        if not self._pages:
            return
        loop = asyncio.get_running_loop()
        due = self._last_s + (FRAME_GAP_S if urgent else RIDE_S)
        if self._timer is not None:
            if self._timer.when() <= due:
                return
            self._timer.cancel()
        self._timer = loop.call_at(max(due, loop.time()), self._tell)

    def _tell(self) -> None:
        self._timer = None
        self._last_s = asyncio.get_running_loop().time()
        for page in self._pages:
            page.tell()

    def _look_round(self) -> None:
        self._look()
        self._state.grow_old(self._now())
        self._frames.clear()  # the time has gone on
        self._tell()
        self._looker = asyncio.get_running_loop().call_later(LOOK_S, self._look_round)

    def _rest(self) -> None:
        for timer in (self._timer, self._looker):
            if timer is not None:
                timer.cancel()
        self._timer = self._looker = None


def _encode(data: Any) -> str:
    return msgspec.json.encode(data).decode()
