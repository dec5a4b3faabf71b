"""Conversion between the clock of ROS 2 and simulated time. Pure, except for the wall clock."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, Literal

NS: Final = 1_000_000_000

EPOCH_NS: Final = 1_700_000_000 * NS
"""Time of ROS 2 at the beginning of virtual time."""

Kind = Literal["wall", "ros"]

MOST_AHEAD_S: Final = 0.1
"""A stamp may be so far ahead of the clock: two machines that NTP keeps together."""

MOST_BEHIND_S: Final = 3600.0

STANDS_S: Final = 1.0
"""Real seconds for which time is assumed to go on after the last message of /clock."""


class RosClock:
    """Converts between the stamps of ROS 2 and simulated seconds of the system.

    Args:
        kind: "wall" if stamps are of the machine's clock; "ros" if they are of the topic /clock,
            as with use_sim_time.
        now_s: returns simulated seconds of the system.
        rate: simulated seconds of the system per real second.
        wall_ns: returns nanoseconds since 1970.
    """

    def __init__(self, kind: Kind, now_s: Callable[[], float], rate: float,
                 wall_ns: Callable[[], int]) -> None:
        self._kind, self._now_s, self._rate, self._wall_ns = kind, now_s, rate, wall_ns
        self._set_ns: int | None = None
        self._set_s = 0.0

    def set(self, clock_ns: int) -> None:
        """Set the time to that of a message of /clock."""
        self._set_ns, self._set_s = clock_ns, self._now_s()

    @property
    def is_known(self) -> bool:
        """Whether the time of ROS 2 is known."""
        return self._kind == "wall" or self._set_ns is not None

    def ros_ns(self) -> int:
        """Return the time of ROS 2; 0 if it is not known."""
        if self._kind == "wall":
            return self._wall_ns()
        if self._set_ns is None:
            return 0
        since_s = min(max(self._now_s() - self._set_s, 0.0), STANDS_S * self._rate)
        return self._set_ns + int(since_s * NS)

    def stamp_ns(self, at_s: float) -> int:
        """Return the stamp in ROS 2 of a simulated time."""
        return self.ros_ns() - int((self._now_s() - at_s) / self._pace * NS)

    def at_s(self, stamp_ns: int) -> float:
        """Return the simulated time of a stamp; one a little ahead counts as now.

        Raises:
            ValueError: the stamp is too far ahead or behind; one line.
        """
        if not self.is_known:
            raise ValueError("clock = 'ros', and no message has come on /clock")
        behind_s = (self.ros_ns() - stamp_ns) / NS
        if behind_s < -MOST_AHEAD_S:
            raise ValueError(f"its stamp is {-behind_s:.3g} s ahead of "
                             f"{'the wall clock' if self._kind == 'wall' else '/clock'}")
        if behind_s > MOST_BEHIND_S:
            hint = ("; if it is simulated time, the gateway needs clock = 'ros'"
                    if self._kind == "wall" and stamp_ns < 10**9 * NS // 2 else "")
            raise ValueError(f"its stamp, {stamp_ns / NS:.3f} s, is hours behind{hint}")
        return self._now_s() - max(behind_s, 0.0) * self._pace

    @property
    def _pace(self) -> float:
        """Simulated seconds of the system per second of ROS 2."""
        return self._rate if self._kind == "wall" else 1.0
