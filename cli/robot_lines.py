"""The lines of a robot in `rampart status`, `rampart top` and `rampart live metrics`."""
# ruff: noqa: ARG002 the base class has no lines

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from typing import Any, ClassVar, NamedTuple

from rampart.actors.bus.topic import Topic

SILENT = "silent"
"""Text for a state of which no message has arrived."""

Latest = Callable[[Topic[Any]], Any]
"""Returns the newest message of a topic, None without any."""


class Row(NamedTuple):
    """A line of `rampart top`: label, text, style, and the topic that it shows."""

    label: str
    text: str
    style: str = ""
    topic: Topic[Any] | None = None


class RobotLines:
    """The lines of a robot: none. An application may name a derived class.

    Class attributes:
        read: topics for `rampart top` and `rampart live metrics`.
        status_read: topics for `rampart status`.
    """

    read: ClassVar[tuple[Topic[Any], ...]] = ()
    status_read: ClassVar[tuple[Topic[Any], ...]] = ()

    def status(self, latest: Latest, plan: Mapping[str, Any], kinds: Collection[str]
               ) -> list[tuple[str, str]]:
        """Return the lines of `rampart status`: label and text.

        Args:
            latest: gives the messages of `status_read`.
            plan: plan of the run, as plain data.
            kinds: kinds of the nodes of the run.
        """
        return []

    def status_data(self, latest: Latest) -> dict[str, Any]:
        """Return the same as data."""
        return {}

    def rows(self, latest: Latest) -> list[Row]:
        """Return the lines of `rampart top`."""
        return []

    def data(self, latest: Latest) -> dict[str, Any]:
        """Return the same as data."""
        return {}

    def families(self, latest: Latest) -> Iterator[Any]:
        """Yield the families (`prometheus_client.Metric`) of `rampart live metrics`."""
        yield from ()
