"""What pages are shown, in sections that remember when they last changed. Pure.

Each change of anything gives the picture a new version. A page that has seen version *v* is sent
the sections that changed since, and of a journal the lines that were added since; one that has
seen nothing (version 0) is sent all. So what a page missed need not be remembered: a page that
was suspended, or could not keep up, gets the newest of everything and no backlog.

A section is turned into JSON when it is sent for the first time, and that once for all pages; then
it is also cut to its bounds (`bounds`). A table has rows of which those that changed are sent.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

import msgspec

from rampart.actors.operator.bounds import LINE, SHOWN, Bounds

JOURNAL_LINES = 60
JOURNAL_BYTES = 100_000

_JSON = msgspec.json.Encoder()


class Section:
    """The latest value of something, and the version in which it became so."""

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
        """Return the whole value as JSON; encoded anew only if it has changed."""
        if self._shown_version != self.version:
            shown, self.left_out = self._bounds.fit(self._show(self.value))
            self._encoded = msgspec.Raw(_JSON.encode(shown))
            self._shown_version = self.version
        return self._encoded


class Journal:
    """The last lines of a log, each with the version in which it was added."""

    __slots__ = ("_bytes", "_lines", "version")

    def __init__(self) -> None:
        self._lines: deque[tuple[int, bytes]] = deque()
        self._bytes = 0
        self.version = 0

    def add(self, line: Any, version: int) -> None:
        """Add a line, cut to its bounds; the oldest are dropped that there is no room for."""
        encoded = _JSON.encode(LINE.fit(line)[0])
        self._lines.append((version, encoded))
        self._bytes += len(encoded)
        while len(self._lines) > JOURNAL_LINES or self._bytes > JOURNAL_BYTES:
            self._bytes -= len(self._lines.popleft()[1])
        self.version = version

    def since(self, version: int) -> list[msgspec.Raw]:
        """Return, as JSON, the lines that were added after a version, the oldest first."""
        return [msgspec.Raw(encoded) for added, encoded in self._lines if added > version]


class Table:
    """Rows by name, each with the version in which it last changed. One that is gone is None.

    Args:
        rows: at most so many are kept, and a row of another name is not.
    """

    __slots__ = ("_most", "_rows", "version")

    def __init__(self, rows: int) -> None:
        self._most = rows
        self._rows: dict[str, tuple[int, Any, msgspec.Raw]] = {}
        self.version = 0

    def set(self, name: str, row: Any, version: int) -> bool:
        """Set a row, or remove it by None; False if that is no change, or there is no room."""
        before = self._rows.get(name)
        if (row is None if before is None else before[1] == row) or (
                before is None and len(self._rows) >= self._most):
            return False
        self._rows[name] = (version, row, msgspec.Raw(_JSON.encode(LINE.fit(row)[0])))
        self.version = version
        return True

    def rows(self) -> dict[str, Any]:
        """Return all rows that there are."""
        return {name: row for name, (_, row, _) in self._rows.items() if row is not None}

    def since(self, version: int) -> dict[str, msgspec.Raw]:
        """Return, as JSON, the rows that changed after a version; since 0, those that there are."""
        return {name: encoded for name, (changed, row, encoded) in self._rows.items()
                if changed > version and not (version == 0 and row is None)}


class Picture:
    """All sections, tables and journals by name, and the version of the whole.

    Attributes:
        version: Grows with each change.
        on_change: Called after each change.
    """

    def __init__(self) -> None:
        self.version = 1  # 0 is what a page has seen that has seen nothing
        self.on_change: Callable[[], None] = lambda: None
        self._sections: dict[str, Section] = {}
        self._tables: dict[str, Table] = {}
        self._journals: dict[str, Journal] = {}
        self._left_out: dict[str, int] = {}
        self._left_out_version = 0

    def section(self, name: str, value: Any = None, show: Callable[[Any], Any] = lambda v: v,
                bounds: Bounds = SHOWN) -> None:
        """Declare a section, its first value, how to show a value and how much of it."""
        self._sections[name] = Section(value, show, bounds)

    def table(self, name: str, rows: int) -> None:
        """Declare a table of so many rows at most."""
        self._tables[name] = Table(rows)

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

    def rows(self, name: str) -> dict[str, Any]:
        """Return the rows of a table."""
        return self._tables[name].rows()

    @property
    def tables(self) -> tuple[str, ...]:
        """Names of the tables, of which the rows are sent that changed."""
        return tuple(self._tables)

    def put_row(self, name: str, row: str, value: Any) -> None:
        """Set a row of a table, None removes it; the same again is no change."""
        if self._tables[name].set(row, value, self.version + 1):
            self.version += 1
            self.on_change()

    def add(self, name: str, line: Any) -> None:
        """Add a line to a journal."""
        self.version += 1
        self._journals[name].add(line, self.version)
        self.on_change()

    def changes(self, since: int) -> dict[str, Any]:
        """Return what changed after a version, each value as JSON already; since 0, everything.

        If that has changed as well, `left_out` says of which sections how many entries are missing.
        """
        parts: dict[str, Section | Table | Journal] = {
            **self._sections, **self._tables, **self._journals}
        changed: dict[str, Any] = {name: part.since(since) for name, part in parts.items()
                                   if since == 0 or part.version > since}
        left_out = {n: section.left_out for n, section in self._sections.items()
                    if section.left_out}
        if left_out != self._left_out:  # known only now that the sections are encoded
            self._left_out, self._left_out_version = left_out, self.version
        if self._left_out_version > since:
            changed["left_out"] = left_out
        return changed
