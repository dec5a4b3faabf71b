"""The rotors' speed controllers, which choose the pilot that they obey. Pure.

They choose by regularity alone, as simple hardware can: the first pilot while it is in time, else
the next. So a pilot that is dead, stopped, slow or late costs nothing, without any detection. They
cannot notice a pilot that is wrong and in time.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from quadrotor.vehicle import MOST_THRUST_N, Thrusts

IDLE_N = 0.3
"""Thrust of an idle rotor, whose speed controller gets no commands."""

LATE_S = 0.03
"""A pilot is late if its newest command is older; pilots command every 10 ms."""

IN_TIME_S = 0.5
"""A pilot is obeyed again after it was in time for this long."""


@dataclass(slots=True)
class _Line:
    """A pilot's last command, and when the pilot was late last."""

    thrusts: Thrusts = (0.0,) * 4
    stamp_s: float = -math.inf
    late_s: float = -math.inf


class SpeedControllers:
    """Carry out the commands of one of several pilots.

    Args:
        pilots: their names, the preferred one first.
        hold_s: how long the last command is carried out.

    Attributes:
        obeys: name of the pilot in command.
        thrusts: its command.
    """

    def __init__(self, pilots: Sequence[str], hold_s: float) -> None:
        self._lines = {name: _Line() for name in pilots}
        self._hold_s = hold_s
        self.obeys = pilots[0]

    def command(self, pilot: str, thrusts: Thrusts, stamp_s: float) -> bool:
        """Take a command if it is newer; return whether it is possible."""
        line = self._lines.get(pilot)
        if line is None or not all(0.0 <= f <= MOST_THRUST_N * 1.01 for f in thrusts):
            return False
        if stamp_s > line.stamp_s:
            line.thrusts, line.stamp_s = thrusts, stamp_s
        return True

    @property
    def thrusts(self) -> Thrusts:
        """The command in force."""
        return self._lines[self.obeys].thrusts

    def age_s(self, now_s: float) -> float:
        """Return the age of the command in force, s; 0 before the first."""
        stamp_s = self._lines[self.obeys].stamp_s
        return max(now_s - stamp_s, 0.0) if stamp_s > -math.inf else 0.0

    def turn(self, now_s: float) -> Thrusts:
        """Choose a pilot, and return the thrust of each rotor, N."""
        lines = self._lines
        for line in lines.values():
            if now_s - line.stamp_s > LATE_S:
                line.late_s = now_s
        if lines[self.obeys].late_s == now_s:
            self.obeys = max(lines, key=lambda name: lines[name].stamp_s)
        else:
            self.obeys = next(name for name, line in lines.items() if name == self.obeys
                              or now_s - line.late_s >= IN_TIME_S)
        if self.age_s(now_s) > self._hold_s:
            first, second, third, fourth = (min(f, IDLE_N) for f in self.thrusts)
            return first, second, third, fourth
        return self.thrusts
