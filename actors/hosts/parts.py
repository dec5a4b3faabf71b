"""A long state on its way to another host, part by part. Pure.

On a line between hosts all that goes one way goes one behind the other: 300 kB at once, over a line
that loses packets and so carries 80 kB a second, hold up every heartbeat behind them for seconds,
and the host counts as lost. So a part is as long as the line has carried soon, and the next one
goes when the other host has said that it is there.
"""

from __future__ import annotations

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
