"""Whether a velocity command is one that the robot could ever be meant to drive."""

from __future__ import annotations

import math

from rampart.actors.detection.lasting import Lasting

_ROUNDING = 1e-6
"""A command clamped to the limit elsewhere, in float32 perhaps, is within it."""


class BoundsCheck:
    """Active from the first bad command until commands have been good for `hold_s`.

    Silence does not make it idle: a source that sent nonsense and then nothing is not cured.

    Args:
        max_linear_mps: top speed, m/s, forward and backward.
        max_angular_radps: top turn rate, rad/s, either way.
        hold_s: how long commands must have been good, s.
        known_after_s: when idle may be claimed without a command heard; -inf for at once.
    """

    def __init__(self, max_linear_mps: float, max_angular_radps: float, hold_s: float,
                 known_after_s: float = -math.inf) -> None:
        self.max_linear_mps = max_linear_mps
        self.max_angular_radps = max_angular_radps
        self.active = False
        self.reason = ""
        self.nodes: tuple[str, ...] = ()
        self.known = known_after_s == -math.inf
        self._known_after_s = known_after_s
        self._good = Lasting(hold_s)

    @property
    def good(self) -> bool:
        """Whether the last command was good."""
        return not self.active or self._good.since_s < math.inf

    @property
    def due_s(self) -> float:
        """Only the wait for a first command ends by itself."""
        return math.inf if self.known else self._known_after_s

    def expire(self, now_s: float) -> None:
        """Give up waiting for a first command: its absence is the subject of DM2, not of this."""
        self.known = self.known or now_s >= self._known_after_s

    def command(self, linear_mps: float, angular_radps: float, now_s: float) -> None:
        """Check a command."""
        self.known = True
        fault = self._fault(linear_mps, angular_radps)
        cured = self._good.note(not fault, now_s)
        if fault:
            self.reason = self.reason or fault
            self.active = True
        elif self.active and cured:
            self.active = False
            self.reason = ""

    def _fault(self, linear_mps: float, angular_radps: float) -> str:
        for what, value, limit, unit in (
            ("speed", linear_mps, self.max_linear_mps, "m/s"),
            ("turn rate", angular_radps, self.max_angular_radps, "rad/s"),
        ):
            if not math.isfinite(value):
                return f"commanded {what} is {value}"
            if abs(value) > limit * (1 + _ROUNDING) + _ROUNDING:
                return f"commanded {what} {value:.2f} {unit} exceeds {limit:g} {unit}"
        return ""
