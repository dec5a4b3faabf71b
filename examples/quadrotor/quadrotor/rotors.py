"""The rotors' speed controllers: whose commands they carry out, and what they do without. Pure.

They choose by regularity alone, as simple hardware can: the first pilot while it commands in time,
else the next. So a pilot that is dead, stopped, slow or late costs nothing, and nobody has to
notice it first. One that is wrong and in time they cannot tell from one that is right.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from quadrotor.vehicle import MOST_THRUST_N, Thrusts

IDLE_N = 0.3
"""Thrust of a rotor whose speed controller gets no commands any more: it turns, no more."""

LATE_S = 0.03
"""A pilot whose newest command is older is late; it commands every 10 ms."""

IN_TIME_S = 0.5
"""For so long a pilot must not have been late before it is gone back to."""


@dataclass(slots=True)
class _Line:
    """What one pilot said last, and when it was late last."""

    thrusts: Thrusts = (0.0,) * 4
    stamp_s: float = -math.inf
    late_s: float = -math.inf


class SpeedControllers:
    """Carry out the commands of one of several pilots.

    Args:
        pilots: their names; the one that comes first is preferred.
        hold_s: how long a command is carried out that is not renewed by anybody.

    Attributes:
        obeys: the pilot whose command is carried out.
        thrusts: its command.
    """

    def __init__(self, pilots: Sequence[str], hold_s: float) -> None:
        self._lines = {name: _Line() for name in pilots}
        self._hold_s = hold_s
        self.obeys = pilots[0]

    def command(self, pilot: str, thrusts: Thrusts, stamp_s: float) -> bool:
        """Take a command; return whether it makes sense. One that is not newer changes nothing."""
        line = self._lines.get(pilot)
        if line is None or not all(0.0 <= f <= MOST_THRUST_N * 1.01 for f in thrusts):
            return False
        if stamp_s > line.stamp_s:
            line.thrusts, line.stamp_s = thrusts, stamp_s
        return True

    @property
    def thrusts(self) -> Thrusts:
        """What the pilot that is obeyed asked for."""
        return self._lines[self.obeys].thrusts

    def age_s(self, now_s: float) -> float:
        """For how long no command came, s; 0 before the first."""
        stamp_s = self._lines[self.obeys].stamp_s
        return max(now_s - stamp_s, 0.0) if stamp_s > -math.inf else 0.0

    def turn(self, now_s: float) -> Thrusts:
        """Choose a pilot, and return what each rotor is driven with, N."""
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
