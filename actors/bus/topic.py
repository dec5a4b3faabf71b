"""What a topic is: a Zenoh key, the type that travels on it, and how it is treated.

A topic family has one `{name}` in its key (`heartbeat/{name}`): `at("DM1")` gives the
concrete key of one member, `pattern` the key expression that covers all of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Generic, TypeVar

import msgspec

ROOT = "rampart"
"""First chunk of every key."""

ROS_SIDE = "ros2-side"
"""First chunk of keys of what passes among nodes of ROS 2: in virtual time, and in recordings."""

T = TypeVar("T", bound=msgspec.Struct)

Members = tuple[str, ...] | None
"""Names of members of a topic family; None for all of them, or where there is no family."""


class Qos(Enum):
    """How a topic's messages travel and wait.

    `SENSOR`: best sample is the newest; the mailbox keeps one per key, latest wins.
    `STATE`: like a sensor, and repeated at `rate_hz` even without change, so that who joins
    late (a respawned node) knows it within one period.
    `COMMAND`: each message counts; the mailbox queues it, bounded, and reports an overflow.
    """

    SENSOR = "sensor"
    STATE = "state"
    COMMAND = "command"


@dataclass(frozen=True, slots=True)
class Topic(Generic[T]):
    """The contract of one key: shown in `topics.md`, enforced by the bus.

    Args:
        key: key below `rampart/`, with at most one `{name}` chunk.
        type: the message struct; units are in its field names (SI).
        qos: see `Qos`.
        rate_hz: nominal publication rate in simulated time; 0 means on event.
        frame: `map`, `odom`, `base_link` (REP-105) or `""`.
        doc: one sentence for `topics.md`.
        outside: tools, or the driver of a device, publish it: no node of the system has to.
        several: more than one node may publish it. Commands always may be given by several; of
            what is measured, or is the case, the latest message wins, so that is one node's to say.
        resend_s: above 0 the newest message is posted where the nodes of the host look
            (`rampart.actors.bus.board`), and sent only if it differs from the one sent last, or so
            many simulated seconds have passed since; in a system of several hosts, always.
        compared: a message that differs from the one sent last is news. If not, it only shows that
            its publisher works.
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
        """Return which member of this family a key below the root is, "" of a plain topic.

        None if the key is not one of this topic's.
        """
        head, family, tail = self.key.partition("{name}")
        name = key[len(head):len(key) - len(tail)]
        fits = key == f"{head}{name}{tail}" and not set("/*{}") & set(name)
        return name if fits and bool(name) == bool(family) else None

    def at(self, name: str | None = None) -> str:
        """Return the full concrete key.

        Raises:
            ValueError: a family was asked without a name, or a plain topic with one.
        """
        if self.is_family != (name is not None):
            need = "needs a name" if self.is_family else "takes no name"
            raise ValueError(f"topic {self.key} {need}, got {name!r}")
        return f"{ROOT}/{self.key.replace('{name}', name)}" if name else f"{ROOT}/{self.key}"
