"""Bounds of what a page shows. Pure.

Messages on the bus can be larger than what a person can read and a browser can draw. Texts and
lists are cut, and the page shows the number of missing entries. Each list has its own bound, so a
long one does not displace others, e.g. the recoveries that wait for a reset.

A text becomes one printable line. A line break could forge a line of the log, and a mark that
changes the direction of writing could forge a name.
"""

from __future__ import annotations

from itertools import islice
from typing import Any

import msgspec

from rampart.files.plain_text import one_line

MAX_NAME = 100
"""Longest name."""

_NUMBER_BYTES = 20


class Bounds(msgspec.Struct, frozen=True):
    """Bounds of a value.

    Attributes:
        text: characters of a text.
        items: entries of a list or mapping.
        room: approximate bytes of a list as JSON.
    """

    text: int = 500
    items: int = 200
    room: int = 8_000

    def fit(self, value: Any) -> tuple[Any, int]:
        """Return a value cut to the bounds, in types of JSON, and the number of missing entries."""
        fitting = _Fitting(self)
        return fitting.value(msgspec.to_builtins(value), None), fitting.left_out


SHOWN = Bounds()
LINE = Bounds(items=40, room=2_000)
"""Bounds of a line of a log."""


class _Room(msgspec.Struct):
    left: int


class _Fitting:
    """Cuts one value; `room` belongs to the outermost list around the part in hand."""

    def __init__(self, bounds: Bounds) -> None:
        self._bounds = bounds
        self.left_out = 0

    def value(self, value: Any, room: _Room | None) -> Any:
        if isinstance(value, str):
            text = one_line(value, self._bounds.text)
            _take(room, len(text.encode(errors="replace")) + 3)
            return text
        if isinstance(value, dict):
            self.left_out += max(0, len(value) - self._bounds.items)
            return {self.value(str(key), room): self.value(entry, room)
                    for key, entry in islice(value.items(), self._bounds.items)}
        if isinstance(value, (list, tuple)):
            return self._list(value, room or _Room(self._bounds.room))
        _take(room, _NUMBER_BYTES)
        return value

    def _list(self, value: list[Any] | tuple[Any, ...], room: _Room) -> list[Any]:
        shown: list[Any] = []
        for entry in value:
            if room.left <= 0 or len(shown) == self._bounds.items:
                self.left_out += len(value) - len(shown)
                break
            shown.append(self.value(entry, room))
        return shown


def _take(room: _Room | None, count: int) -> None:
    if room is not None:
        room.left -= count
