"""What pages are shown, in sections that remember when they last changed. Pure.

Each change of anything gives the picture a new version. A page that has seen version *v* is sent
the sections that changed since, and of a journal the lines that were added since; one that has
seen nothing (version 0) is sent all. So nobody has to remember what a page missed: a page that
was suspended, or could not keep up, gets the newest of everything and no backlog.

A section is turned into JSON when it is sent for the first time, and that once for all pages.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

import msgspec

JOURNAL_LINES = 60

_JSON = msgspec.json.Encoder()


class Section:
    """The latest value of something, and the version in which it became so."""

    __slots__ = ("_encoded", "_show", "_shown_version", "value", "version")

    def __init__(self, show: Callable[[Any], Any]) -> None:
        self.value: Any = None
        self.version = 0
        self._show = show
        self._encoded = msgspec.Raw(b"null")
        self._shown_version = -1

    def shown(self) -> Any:
        """Return the value as pages see it, before it is JSON."""
        return self._show(self.value)

    def encoded(self) -> msgspec.Raw:
        """Return it as JSON; encoded anew only if it has changed."""
        if self._shown_version != self.version:
            self._encoded = msgspec.Raw(_JSON.encode(self.shown()))
            self._shown_version = self.version
        return self._encoded


class Journal:
    """The last lines of a log, each with the version in which it was added."""

    __slots__ = ("_lines", "version")

    def __init__(self) -> None:
        self._lines: deque[tuple[int, Any, msgspec.Raw]] = deque(maxlen=JOURNAL_LINES)
        self.version = 0

    def add(self, line: Any, version: int) -> None:
        """Add a line; beyond `JOURNAL_LINES` the oldest is dropped."""
        self._lines.append((version, line, msgspec.Raw(_JSON.encode(line))))
        self.version = version

    def lines(self) -> list[Any]:
        """Return all lines, the oldest first."""
        return [line for _, line, _ in self._lines]

    def since(self, version: int) -> list[msgspec.Raw]:
        """Return, as JSON, the lines that were added after a version."""
        return [encoded for added, _, encoded in self._lines if added > version]


class Picture:
    """All sections and journals by name, and the version of the whole.

    Attributes:
        version: Grows with each change.
        on_change: Called after each change with whether somebody should see it at once; what is
            not urgent may wait for the next urgent change, or a tenth of a second.
    """

    def __init__(self) -> None:
        self.version = 1  # 0 is what a page has seen that has seen nothing
        self.on_change: Callable[[bool], None] = lambda _urgent: None
        self._sections: dict[str, Section] = {}
        self._journals: dict[str, Journal] = {}

    def section(self, name: str, value: Any = None, show: Callable[[Any], Any] = lambda v: v
                ) -> None:
        """Declare a section, its first value and how to show a value."""
        self._sections[name] = made = Section(show)
        made.value = value

    def journal(self, name: str) -> None:
        """Declare a journal."""
        self._journals[name] = Journal()

    def value(self, name: str) -> Any:
        """Return the present value of a section."""
        return self._sections[name].value

    def put(self, name: str, value: Any, *, urgent: bool = True) -> None:
        """Set a section; the same value again is no change."""
        section = self._sections[name]
        if section.value == value:
            return
        section.value = value
        self.version = section.version = self.version + 1
        self.on_change(urgent)

    def add(self, name: str, line: Any) -> None:
        """Add a line to a journal."""
        self.version += 1
        self._journals[name].add(line, self.version)
        self.on_change(True)

    def all(self) -> dict[str, Any]:
        """Return everything as it is shown."""
        return {**{name: section.shown() for name, section in self._sections.items()},
                **{name: journal.lines() for name, journal in self._journals.items()}}

    def changes(self, since: int) -> dict[str, Any]:
        """Return what changed after a version, each value as JSON already; since 0, everything."""
        whole = since == 0
        changed: dict[str, Any] = {
            name: section.encoded() for name, section in self._sections.items()
            if whole or section.version > since}
        for name, journal in self._journals.items():
            if whole or journal.version > since:
                changed[name] = journal.since(since)
        return changed
