"""The contents of pages, in parts that know when they last changed. Pure.

Each change gives the picture a new version. A page at version *v* receives the sections and log
lines that changed since *v*; a new page (version 0) receives everything. So nothing has to be kept
for a page that was suspended or too slow: it receives the newest contents and no backlog.

A section is cut to its bounds and encoded when it is first sent, once for all pages: messages on
the bus can be larger than what a person can read. The page shows the number of missing entries.
Each list has its own bound, so a long one does not displace others, e.g. the recoveries that wait
for a reset.

A text becomes one printable line. A line break could forge a line of the log, and a mark that
changes the direction of writing could forge a name.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
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


JOURNAL_LINES = 60
JOURNAL_BYTES = 100_000

_JSON = msgspec.json.Encoder()


class Section:
    """A value, and the version of its last change."""

    __slots__ = ("_bounds", "_encoded", "_show", "_shown_version", "left_out", "value", "version")

    def __init__(self, value: Any, show: Callable[[Any], Any], bounds: Bounds) -> None:
        self.value = value
        self.version = 0
        self.left_out = 0
        self._show = show
        self._bounds = bounds
        self._encoded = msgspec.Raw(b"null")
        self._shown_version = -1

    def since(self, _version: int) -> msgspec.Raw:
        """Return the whole value as JSON, encoded only if it has changed."""
        if self._shown_version != self.version:
            shown, self.left_out = self._bounds.fit(self._show(self.value))
            self._encoded = msgspec.Raw(_JSON.encode(shown))
            self._shown_version = self.version
        return self._encoded


class Journal:
    """The last lines of a log, each with its version."""

    __slots__ = ("_bytes", "_lines", "version")

    def __init__(self) -> None:
        self._lines: deque[tuple[int, bytes]] = deque()
        self._bytes = 0
        self.version = 0

    def add(self, line: Any, version: int) -> None:
        """Add a line, cut to its bounds; old lines are dropped to make room."""
        encoded = _JSON.encode(LINE.fit(line)[0])
        self._lines.append((version, encoded))
        self._bytes += len(encoded)
        while len(self._lines) > JOURNAL_LINES or self._bytes > JOURNAL_BYTES:
            self._bytes -= len(self._lines.popleft()[1])
        self.version = version

    def since(self, version: int) -> list[msgspec.Raw]:
        """Return the lines after a version as JSON, the oldest first."""
        return [msgspec.Raw(encoded) for added, encoded in self._lines if added > version]


class Picture:
    """All sections and journals by name, and the version of the whole.

    Attributes:
        version: grows with each change.
        on_change: called after each change.
    """

    def __init__(self) -> None:
        self.version = 1  # a new page is at 0
        self.on_change: Callable[[], None] = lambda: None
        self._sections: dict[str, Section] = {}
        self._journals: dict[str, Journal] = {}

    def section(self, name: str, value: Any = None, show: Callable[[Any], Any] = lambda v: v,
                bounds: Bounds = SHOWN) -> None:
        """Declare a section with its first value, a conversion for pages, and bounds."""
        self._sections[name] = Section(value, show, bounds)

    def journal(self, name: str) -> None:
        """Declare a journal."""
        self._journals[name] = Journal()

    def value(self, name: str) -> Any:
        """Return the present value of a section."""
        return self._sections[name].value

    def put(self, name: str, value: Any) -> None:
        """Set a section; the same value again is no change."""
        section = self._sections[name]
        if section.value == value:
            return
        section.value = value
        self.version = section.version = self.version + 1
        self.on_change()

    def add(self, name: str, line: Any) -> None:
        """Add a line to a journal."""
        self.version += 1
        self._journals[name].add(line, self.version)
        self.on_change()

    def changes(self, since: int) -> dict[str, Any]:
        """Return the parts that changed after a version as JSON; since 0, everything.

        `left_out` has the number of missing entries by section.
        """
        parts: dict[str, Section | Journal] = {**self._sections, **self._journals}
        changed: dict[str, Any] = {name: part.since(since) for name, part in parts.items()
                                   if since == 0 or part.version > since}
        changed["left_out"] = {name: section.left_out for name, section in self._sections.items()
                               if section.left_out}  # known now that the sections are encoded
        return changed
