"""One pending call of an actor, which can be taken back until the moment it is made."""

from __future__ import annotations

from collections.abc import Callable


class Timer:
    """A pending `call_later`; `cancel` is harmless after it has run."""

    __slots__ = ("_call", "_release")

    def __init__(self, call: Callable[[], None]) -> None:
        self._call: Callable[[], None] | None = call
        self._release: Callable[[], None] = lambda: None

    def arm(self, release: Callable[[], None]) -> None:
        """Keep what takes the timer from the loop."""
        self._release = release

    def cancel(self) -> None:
        """Make sure the call does not happen (any more)."""
        self._call = None
        self._release()

    def fire(self) -> None:
        """Make the call, unless it was cancelled while it waited in the mailbox."""
        call, self._call = self._call, None
        if call is not None:
            call()
