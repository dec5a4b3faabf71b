"""How much of what was heard pages are shown. Pure.

A node on the bus may say as much as a message holds; a page is for a person, and has to be
drawn. Texts are clipped, lists end, and how many entries were left out is counted and shown. Each
list has its own room, so that a long one takes nothing from what stands beside it: the recoveries
that wait for a reset, for instance.

A text is shown as one printable line: a line break could look like a line of the log, and a mark
that turns the direction of writing like another name.
"""

from __future__ import annotations

from itertools import islice
from typing import Any

import msgspec

from rampart.files.plain_text import one_line

MAX_NAME = 100
"""Characters of a name."""

_NUMBER_BYTES = 20


class Bounds(msgspec.Struct, frozen=True):
    """How much is shown of a value.

    Attributes:
        text: characters of a text.
        items: entries of a list or mapping.
        room: bytes of a list, as JSON, about.
    """

    text: int = 500
    items: int = 200
    room: int = 8_000

    def fit(self, value: Any) -> tuple[Any, int]:
        """Return a value as it is shown, made of JSON's types, and how many entries are missing."""
        fitting = _Fitting(self)
        return fitting.value(msgspec.to_builtins(value), None), fitting.left_out


SHOWN = Bounds()
LINE = Bounds(items=40, room=2_000)
"""A line of a log."""


class _Room(msgspec.Struct):
    left: int


class _Fitting:
    """One value on its way; `room` is that of the outermost list round what is looked at."""

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
