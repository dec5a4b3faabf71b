"""DM9's monitor: two computers of one command, compared. Pure.

The comparison cannot tell who is wrong. It accuses one after the other, the one whose restart
costs least first; if they still differ when that one has come back, it was the other. Meanwhile
the Safety Pilot drives what is safe whoever is right
(`rampart.actors.osmosis.control.pilot.command_pair`).

A turn rate that is wrong leads out of the lane and is not waited for. A speed may differ for as
long as a respawned follower needs to accelerate; the slower one drives meanwhile.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import msgspec

from rampart.actors.bus.plausible import is_possible
from rampart.actors.detection.lasting import Lasting
from rampart.manager.spec.tables import NonNegative


class ComparisonLimits(msgspec.Struct, frozen=True):
    """What is a disagreement.

    Args:
        linear_mps: difference of speed that is none.
        angular_radps: difference of turn rate that is none.
        linear_s: how long speeds may differ: the ramp of a follower that begins anew, and more.
        angular_s: how long turn rates may differ.
        hold_s: how long they must have agreed again.
        fresh_s: an older command is not compared.
        forget_s: without anything to compare for so long, nothing is claimed: that the silent one
            is missing is said by others.
    """

    linear_mps: NonNegative = 0.25
    angular_radps: NonNegative = 0.35
    linear_s: NonNegative = 2.0
    angular_s: NonNegative = 0.4
    hold_s: NonNegative = 0.5
    fresh_s: NonNegative = 0.2
    forget_s: NonNegative = 3.0


@dataclass(slots=True)
class _Source:
    """One of the two. `stamp_s` is when its command was true."""

    linear_mps: float = 0.0
    angular_radps: float = 0.0
    stamp_s: float = -math.inf
    incarnation: int = 0


class CommandComparison:
    """Active while two sources of one command disagree; accuses them in turn.

    Args:
        sources: names of the nodes, in the order in which they are accused.
        limits: what is a disagreement.
        known_after_s: when idle may be claimed without anything heard; -inf for at once.
    """

    def __init__(self, sources: tuple[str, str], limits: ComparisonLimits | None = None,
                 known_after_s: float = -math.inf) -> None:
        self.limits = limits or ComparisonLimits()
        self.active = False
        self.reason = ""
        self.nodes: tuple[str, ...] = ()
        self.known = known_after_s == -math.inf
        self._known_after_s = known_after_s
        self._sources = {name: _Source() for name in sources}
        self._order = sources
        self._accused = -1
        self._linear = Lasting(self.limits.linear_s)
        self._angular = Lasting(self.limits.angular_s)
        self._agreed = Lasting(self.limits.hold_s)
        self._compared_s = -math.inf

    @property
    def due_s(self) -> float:
        """When it gives up waiting for something to compare."""
        if not self.known:
            return self._known_after_s
        return self._compared_s + self.limits.forget_s if self.active else math.inf

    def expire(self, now_s: float) -> None:
        """Claim nothing when there has been nothing to compare."""
        if not self.known:
            self.known = now_s >= self._known_after_s
        elif self.active and now_s >= self._compared_s + self.limits.forget_s:
            self._clear()

    def heard(self, source: str, command: tuple[float, float], stamp_s: float, incarnation: int,
              now_s: float) -> None:
        """Take a command, (m/s, rad/s), that was computed at `stamp_s`; then compare."""
        one = self._sources[source]
        if incarnation != one.incarnation:
            one.incarnation = incarnation
            self._linear.forget()
            self._angular.forget()
        if not all(map(math.isfinite, command)) or not is_possible(stamp_s, now_s):
            return  # the subject of others
        one.linear_mps, one.angular_radps = command
        one.stamp_s = stamp_s
        a, b = self._sources.values()
        if now_s - min(a.stamp_s, b.stamp_s) <= self.limits.fresh_s:
            self._compare(a, b, now_s)

    def _compare(self, a: _Source, b: _Source, now_s: float) -> None:
        limits = self.limits
        self.known = True
        self._compared_s = now_s
        faster = abs(a.linear_mps - b.linear_mps) > limits.linear_mps
        turning = abs(a.angular_radps - b.angular_radps) > limits.angular_radps
        # Both are told, always: `or` alone would leave the second one out.
        too_long = [self._linear.note(faster, now_s), self._angular.note(turning, now_s)]
        if any(too_long):
            self._disagree(a, b)
        if self._agreed.note(not (faster or turning), now_s) and self.active:
            self._clear()

    def _disagree(self, a: _Source, b: _Source) -> None:
        if not self.active:
            self.active = True
            self.reason = (
                f"commands differ: {a.linear_mps:.2f} m/s {a.angular_radps:.2f} rad/s and "
                f"{b.linear_mps:.2f} m/s {b.angular_radps:.2f} rad/s")
            self._accuse(0)
        elif self._accused < 1 and not self._lives(self.nodes[0]):
            self._accuse(1)

    def _accuse(self, index: int) -> None:
        self._accused = index
        name = self._order[index]
        self.nodes = (f"{name}#{self._sources[name].incarnation}",)

    def _lives(self, accused: str) -> bool:
        name, _, life = accused.partition("#")
        return self._sources[name].incarnation == int(life)

    def _clear(self) -> None:
        self.active = False
        self.reason = ""
        self.nodes = ()
        self._accused = -1
