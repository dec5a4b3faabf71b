"""The one exception of this package, and the way its messages are built."""

from __future__ import annotations

from dataclasses import dataclass

from rampart.files.reading import plain_line


class AirportError(ValueError):
    """An airport or mission file is wrong: one line naming file, field, value and the remedy."""

    def __init__(self, line: str) -> None:
        super().__init__(plain_line(line))


@dataclass(frozen=True, slots=True)
class Problem:
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
        return plain_line(f"{file}: {self.field}: {self.value}: {self.remedy}")
