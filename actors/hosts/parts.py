"""A long state on its way to another host, part by part. Pure.

On a line between hosts all that goes one way goes one behind the other: 300 kB at once, over a line
that loses packets and so carries 80 kB a second, hold up every heartbeat behind them for seconds,
and the host counts as lost. So a part is as long as the line has carried soon, and the next one
goes when the other host has said that it is there.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field

from rampart.actors.ftm.messages import PART_BYTES, StateCopy
from rampart.actors.runtime.checkpoint import Record

SOON_S = 0.1
"""A part that took less than that above the soonest answer is followed by one of twice its length,
else of half of it: that long may something wait behind it."""

_LEAST_BYTES = 4096
"""Of the first part, too: what it takes is nearly the way alone."""

_LAST = 8

_WAIT_S = 2.0
"""Real seconds without a byte of it after which the last state of a node that is given back is no
longer waited for."""

_WAIT_AT_MOST_S = 10.0
"""Real seconds after which it is not in any case."""

_ASKED_S = 0.2
"""Who has not been asked for so long was run there again meanwhile."""

Age = tuple[int, int]
Of = tuple[Age, int, int, bytes]


def whole(copy: StateCopy) -> Of:
    """Return which state a part is of: age, version, size and checksum of the whole."""
    return (copy.incarnation, copy.generation), copy.version, copy.size, copy.checksum


@dataclass(slots=True)
class Coming:
    """A long state of which some has come, or all, and is not kept yet.

    Attributes:
        of: Which state.
        data: What has come.
    """

    of: Of
    data: bytearray = field(default_factory=bytearray)

    @property
    def age(self) -> Age:
        """Of the state: incarnation and generation."""
        return self.of[0]

    def gives_way_to(self, copy: StateCopy) -> bool:
        """Whether a part is of another state, no older than this one."""
        return self.of != whole(copy) and self.age <= (copy.incarnation, copy.generation)

    def with_part(self, copy: StateCopy) -> bytearray:
        """Return what has come, with this part if it is the next one; nothing of another state."""
        if self.of != whole(copy):
            return bytearray()
        if copy.offset == len(self.data) < copy.size:
            self.data += copy.state
        return self.data


@dataclass(slots=True)
class Going:
    """A long state that is under way to another host.

    Attributes:
        node: Whose.
        record: It.
        checksum: Of it.
        there: How many bytes the other host has, as far as it was known when a part was sent last.
        sent_s: When that was.
    """

    node: str
    record: Record
    checksum: bytes
    there: int = 0
    sent_s: float | None = None


@dataclass(slots=True)
class Line:
    """What is known of the way to another host.

    Attributes:
        part_bytes: How much is sent at once.
        took_s: How soon the last parts were answered: the way may become longer.
    """

    part_bytes: int = _LEAST_BYTES
    took_s: deque[float] = field(default_factory=lambda: deque(maxlen=_LAST))

    def answered(self, after_s: float) -> None:
        """Note that a part was answered."""
        self.took_s.append(after_s)
        if after_s < min(self.took_s) + SOON_S:
            self.part_bytes = min(2 * self.part_bytes, PART_BYTES)
        else:
            self.missed()

    def missed(self) -> None:
        """Note that one was not, in time."""
        self.part_bytes = max(self.part_bytes // 2, _LEAST_BYTES)


@dataclass(slots=True)
class Wait:
    """For the last states of nodes that were given back.

    Attributes:
        since_s: Since when, real seconds.
        came_s: When some of them came last.
        asked_s: When it was asked last whether it is over.
        came: What has come.
    """

    since_s: float
    came_s: float = -math.inf
    asked_s: float = -math.inf
    came: tuple[tuple[Age, int], ...] = ()

    def is_vain(self, now_s: float, came: tuple[tuple[Age, int], ...]) -> bool:
        """Whether it has lasted for too long; it has begun anew if it was not asked for a while."""
        if now_s - self.asked_s > _ASKED_S:
            self.since_s = self.came_s = now_s
        if came != self.came:
            self.came_s, self.came = now_s, came
        self.asked_s = now_s
        return now_s - self.came_s >= _WAIT_S or now_s - self.since_s >= _WAIT_AT_MOST_S
