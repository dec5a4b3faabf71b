"""The one exception of this package, and the way its messages are built."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

import msgspec

from rampart.files.plain_text import one_line
from rampart.files.reading import FileError


class AirportError(ValueError):
    """An airport or mission file is wrong: one line naming file, field, value and the remedy."""

    def __init__(self, line: str) -> None:
        super().__init__(one_line(line))


class Problem(msgspec.Struct, frozen=True):
    """One finding about an airport.

    Args:
        field: where, as a path into the file (`missions.AB.goals[2]`).
        value: the offending value, as text.
        remedy: what would be right.
        tolerable: a foreign file may have it; it becomes a warning there.
    """

    field: str
    value: str
    remedy: str
    tolerable: bool = False

    def line(self, file: str) -> str:
        """Return the one-line message for `file`."""
        return one_line(f"{file}: {self.field}: {self.value}: {self.remedy}")


@contextlib.contextmanager
def readable(file: str | Path, remedy: str, what: str = "file") -> Iterator[None]:
    """Have a file that cannot be read, or is not what it should be, refused like all else.

    Args:
        file: for the message.
        remedy: for what is not as it should be.
        what: is read.
    """
    try:
        yield
    except OSError as error:
        raise AirportError(f"{file}: cannot be read: {error.strerror}: give a readable file"
                           ) from None
    except FileError as error:
        raise AirportError(f"{file}: {what}: {error}: {remedy}") from None
