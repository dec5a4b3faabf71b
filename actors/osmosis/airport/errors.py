"""The exception of this package and the form of its messages."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

import msgspec

from rampart.files.plain_text import one_line
from rampart.files.reading import FileError


class AirportError(ValueError):
    """An airport or mission file is invalid: one line with file, field, value and remedy."""

    def __init__(self, line: str) -> None:
        super().__init__(one_line(line))


class Problem(msgspec.Struct, frozen=True):
    """A problem of an airport.

    Args:
        field: path into the file, such as `missions.AB.goals[2]`.
        value: the invalid value, as text.
        remedy: what is expected.
        tolerable: only a warning in the formats of the paper's authors.
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
    """Turn the errors of reading a file into `AirportError`.

    Args:
        file: named in the message.
        remedy: what is expected of the content.
        what: kind of file.
    """
    try:
        yield
    except OSError as error:
        raise AirportError(f"{file}: cannot be read: {error.strerror}: expected a readable file"
                           ) from None
    except FileError as error:
        raise AirportError(f"{file}: {what}: {error}: {remedy}") from None
