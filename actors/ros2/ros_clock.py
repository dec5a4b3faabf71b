"""What time it is to ROS 2, and what that is in simulated time. Pure, but for the wall clock."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, Literal

NS: Final = 1_000_000_000

EPOCH_NS: Final = 1_700_000_000 * NS
"""What time it is to ROS 2 at the beginning of virtual time."""

Kind = Literal["wall", "ros"]

MOST_AHEAD_S: Final = 0.1
"""So far ahead of the clock a stamp may be: clocks of two machines that NTP keeps together."""

MOST_BEHIND_S: Final = 3600.0

STANDS_S: Final = 1.0
"""So long, real seconds, simulated time is taken to go on after the last message of /clock."""


class RosClock:
    """Converts between the stamps of ROS 2 and simulated seconds of the system.

    Args:
        kind: "wall": stamps are of the machine's clock; "ros": of the topic /clock, as with
            use_sim_time.
        now_s: returns simulated seconds of the system.
        rate: simulated seconds of the system in a real one.
        wall_ns: returns nanoseconds since 1970.
    """

    def __init__(self, kind: Kind, now_s: Callable[[], float], rate: float,
                 wall_ns: Callable[[], int]) -> None:
        self._kind, self._now_s, self._rate, self._wall_ns = kind, now_s, rate, wall_ns
        self._told_ns: int | None = None
        self._told_s = 0.0

    def tell(self, clock_ns: int) -> None:
        """Take note of a message of /clock."""
        self._told_ns, self._told_s = clock_ns, self._now_s()

    @property
    def is_known(self) -> bool:
        """Whether it is known what time it is to ROS 2."""
        return self._kind == "wall" or self._told_ns is not None

    def ros_ns(self) -> int:
        """Return what time it is to ROS 2; 0 if that is not known."""
        if self._kind == "wall":
            return self._wall_ns()
        if self._told_ns is None:
            return 0
        since_s = min(max(self._now_s() - self._told_s, 0.0), STANDS_S * self._rate)
        return self._told_ns + int(since_s * NS)

    def stamp_ns(self, at_s: float) -> int:
        """Return the stamp of what was true at a simulated time."""
        return self.ros_ns() - int((self._now_s() - at_s) / self._pace * NS)

    def at_s(self, stamp_ns: int) -> float:
        """Return the simulated time of a stamp, which is not later than now.

        Raises:
            ValueError: it cannot be true; one line.
        """
        if not self.is_known:
            raise ValueError("clock = 'ros', and no message has come on /clock")
        behind_s = (self.ros_ns() - stamp_ns) / NS
        if behind_s < -MOST_AHEAD_S:
            raise ValueError(f"its stamp is {-behind_s:.3g} s ahead of "
                             f"{'the wall clock' if self._kind == 'wall' else '/clock'}")
        if behind_s > MOST_BEHIND_S:
            hint = ("; of simulated time? then the gateway needs clock = 'ros'"
                    if self._kind == "wall" and stamp_ns < 10**9 * NS // 2 else "")
            raise ValueError(f"its stamp, {stamp_ns / NS:.3f} s, is hours behind{hint}")
        return self._now_s() - max(behind_s, 0.0) * self._pace

    @property
    def _pace(self) -> float:
        """Simulated seconds of the system in one of the clock of ROS 2."""
        return self._rate if self._kind == "wall" else 1.0
