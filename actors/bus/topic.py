"""A topic: a Zenoh key, the type of its messages, and how they are delivered.

The key of a topic family has one `{name}` (`heartbeat/{name}`). `at("DM1")` returns the key of one
member, `pattern` the key expression of all.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Generic, TypeVar

import msgspec

ROOT = "rampart"
"""First chunk of every key."""

ROS_SIDE = "ros2-side"
"""First chunk of the keys of ROS 2 traffic, in virtual time and in recordings."""

T = TypeVar("T", bound=msgspec.Struct)

Members = tuple[str, ...] | None
"""Names of members of a topic family; None for all of them, or for a plain topic."""


class Qos(Enum):
    """How a topic's messages travel and wait.

    `SENSOR`: The mailbox keeps the latest message of each key.
    `STATE`: Like a sensor, and repeated at `rate_hz` without change, so that a restarted node knows
    it within one period.
    `COMMAND`: Each message counts. The mailbox queues it, bounded, and reports an overflow.
    """

    SENSOR = "sensor"
    STATE = "state"
    COMMAND = "command"


@dataclass(frozen=True, slots=True)
class Topic(Generic[T]):
    """The contract of one key: shown in `topics.md`, enforced by the bus.

    Args:
        key: Key below `rampart/`, with at most one `{name}` chunk.
        type: The message struct; units are in its field names (SI).
        qos: See `Qos`.
        rate_hz: Nominal publication rate in simulated time; 0 means on event.
        frame: `map`, `odom`, `base_link` (REP-105) or `""`.
        doc: One sentence for `topics.md`.
        outside: Tools or device drivers publish it, so no node of the system has to.
        several: More than one node may publish it. Commands may always have several publishers. Of
            sensors and states the latest message wins, so one node publishes them.
        resend_s: Above 0, each message is posted for the nodes of the host
            (`rampart.actors.bus.board`). It is sent only if it differs from the last one sent, or
            this many simulated seconds after it. With several hosts every message is sent.
        compared: Whether a different message is sent at once. If not, the messages only show that
            their publisher works.
    """

    key: str
    type: type[T]
    qos: Qos
    rate_hz: float
    frame: str
    doc: str
    outside: bool = False
    several: bool = False
    resend_s: float = 0.0
    compared: bool = True

    @property
    def is_family(self) -> bool:
        """Whether the key has a `{name}` chunk."""
        return "{name}" in self.key

    @property
    def pattern(self) -> str:
        """The full key expression that covers every member."""
        return f"{ROOT}/{self.key.replace('{name}', '*')}"

    def member(self, key: str) -> str | None:
        """Return the family member of a key below the root; "" for a plain topic.

        None if the key does not belong to this topic.
        """
        head, family, tail = self.key.partition("{name}")
        name = key[len(head):len(key) - len(tail)]
        fits = key == f"{head}{name}{tail}" and not set("/*{}") & set(name)
        return name if fits and bool(name) == bool(family) else None

    def at(self, name: str | None = None) -> str:
        """Return the full concrete key.

        Raises:
            ValueError: A family needs a name, a plain topic takes none.
        """
        if self.is_family != (name is not None):
            need = "needs a name" if self.is_family else "takes no name"
            raise ValueError(f"topic {self.key} {need}, got {name!r}")
        return f"{ROOT}/{self.key.replace('{name}', name)}" if name else f"{ROOT}/{self.key}"
