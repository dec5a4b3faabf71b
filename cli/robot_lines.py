"""What a robot adds to `rampart status`, `rampart top` and `rampart live metrics`."""
# ruff: noqa: ARG002 a robot that says nothing needs nothing

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from typing import Any, ClassVar, NamedTuple

from rampart.actors.bus.topic import Topic

SILENT = "silent"
"""What there is to say of whoever was not heard."""

Latest = Callable[[Topic[Any]], Any]
"""Returns the newest message of a topic, None if none was heard."""


class Row(NamedTuple):
    """A line of `rampart top`: what it is about, words, style, and the state that it tells of."""

    label: str
    text: str
    style: str = ""
    topic: Topic[Any] | None = None


class RobotLines:
    """The lines of a robot that says nothing; an application may name a class derived from this.

    Class attributes:
        read: topics for `rampart top` and `rampart live metrics`.
        status_read: topics for `rampart status`.
    """

    read: ClassVar[tuple[Topic[Any], ...]] = ()
    status_read: ClassVar[tuple[Topic[Any], ...]] = ()

    def status(self, latest: Latest, plan: Mapping[str, Any], kinds: Collection[str]
               ) -> list[tuple[str, str]]:
        """Return the lines of `rampart status`: a word, and what there is to say.

        Args:
            latest: of `status_read`.
            plan: of the run, as plain data.
            kinds: of the nodes that there are.
        """
        return []

    def status_data(self, latest: Latest) -> dict[str, Any]:
        """Return the same as data."""
        return {}

    def rows(self, latest: Latest, width: int) -> list[Row]:
        """Return the lines of `rampart top` for a screen so many cells wide."""
        return []

    def data(self, latest: Latest) -> dict[str, Any]:
        """Return the same as data."""
        return {}

    def families(self, latest: Latest) -> Iterator[Any]:
        """Yield the families (`prometheus_client.Metric`) of `rampart live metrics`."""
        yield from ()
