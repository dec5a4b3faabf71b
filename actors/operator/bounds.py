"""Bounds of what a page shows. Pure.

Messages on the bus can be larger than what a person can read. Texts and lists are cut, and the page
shows the number of missing entries. Each list has its own bound, so a long one does not displace
others, e.g. the recoveries that wait for a reset.

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


class Bounds(msgspec.Struct, frozen=True):
    """Bounds of a value.

    Attributes:
        text: characters of a text.
        items: entries of a list or mapping.
    """

    text: int = 500
    items: int = 200

    def fit(self, value: Any) -> tuple[Any, int]:
        """Return a value cut to the bounds, in types of JSON, and the number of missing entries."""
        left_out = 0

        def cut(value: Any) -> Any:
            nonlocal left_out
            if isinstance(value, str):
                return one_line(value, self.text)
            if not isinstance(value, dict | list | tuple):
                return value
            left_out += max(0, len(value) - self.items)
            if isinstance(value, dict):
                return {cut(str(key)): cut(entry)
                        for key, entry in islice(value.items(), self.items)}
            return [cut(entry) for entry in value[:self.items]]

        return cut(msgspec.to_builtins(value)), left_out


SHOWN = Bounds()
LINE = Bounds(items=40)
"""Bounds of a line of a log."""
