"""DM9: command calculation error, by comparison of Osmosis Control with its hot standby.

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

from rampart.actors.detection.finding import Finding, Lasting
from rampart.actors.detection.module import DetectionModule
from rampart.actors.ftm.plausible import is_possible
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.runtime.actor import Context, Header, on
from rampart.actors.runtime.parameters import NodeNames
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


class CommandComparison(Finding):
    """Active while two sources of one command disagree; accuses them in turn.

    Args:
        sources: names of the nodes, in the order in which they are accused.
        limits: what is a disagreement.
        known_after_s: when idle may be claimed without anything heard; -inf for at once.
    """

    def __init__(self, sources: tuple[str, str], limits: ComparisonLimits | None = None,
                 known_after_s: float = -math.inf) -> None:
        super().__init__(known_after_s)
        self.limits = limits or ComparisonLimits()
        self._sources = {name: _Source() for name in sources}
        self._accused = ""
        self._linear = Lasting(self.limits.linear_s)
        self._angular = Lasting(self.limits.angular_s)
        self._agreed = Lasting(self.limits.hold_s)
        self._compared_s = -math.inf

    @property
    def due_s(self) -> float:
        """When it gives up waiting for something to compare."""
        return self._compared_s + self.limits.forget_s if self.active else super().due_s

    def expire(self, now_s: float) -> None:
        """Claim nothing when there has been nothing to compare."""
        super().expire(now_s)
        if now_s >= self._compared_s + self.limits.forget_s:
            self.clear()

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
        if self._agreed.note(not (faster or turning), now_s):
            self.clear()

    def _disagree(self, a: _Source, b: _Source) -> None:
        first, second = self._sources
        if not self.active:
            self.reason = (
                f"commands differ: {a.linear_mps:.2f} m/s {a.angular_radps:.2f} rad/s and "
                f"{b.linear_mps:.2f} m/s {b.angular_radps:.2f} rad/s")
            self._accuse(first)
        elif self._accused == first and self.nodes != (self._incarnation(first),):
            self._accuse(second)

    def _accuse(self, name: str) -> None:
        self._accused = name
        self.nodes = (self._incarnation(name),)

    def _incarnation(self, name: str) -> str:
        return f"{name}#{self._sources[name].incarnation}"


_FIRST_PAIR_S = 0.3
"""A respawned module waits this long for two commands before it says idle."""


class CommandDisagreement(DetectionModule):
    """Active while the two computers of the command disagree; names who is to be respawned."""

    class Parameters(DetectionModule.Parameters, ComparisonLimits, frozen=True):
        """Whom it compares; what it lets pass as of `ComparisonLimits`.

        Attributes:
            suspects: names of the two nodes in the order in which they are accused; by default
                the standby first, whose restart costs nothing.
        """

        suspects: NodeNames = ("standby_control", "osmosis_control")

        def __post_init__(self) -> None:
            """Check what a type cannot say."""
            if not len(set(self.suspects)) == len(self.suspects) == 2 \
                    or "osmosis_control" not in self.suspects:
                raise ValueError("suspects: expected osmosis_control and its standby")

    parameters: Parameters

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        first, second = self.parameters.suspects
        self._standby = second if first == "osmosis_control" else first
        self.monitor = self.judged_by(CommandComparison(
            (first, second), self.parameters, self.known_after_s(_FIRST_PAIR_S)))

    @on(topics.COMMAND)
    def command(self, message: m.Twist, header: Header) -> None:
        """Hear the active one."""
        self._heard("osmosis_control", message, header)

    @on(topics.STANDBY_COMMAND)
    def standby(self, message: m.Twist, header: Header) -> None:
        """Hear the standby."""
        self._heard(self._standby, message, header)

    def _heard(self, source: str, message: m.Twist, header: Header) -> None:
        self.monitor.heard(source, (message.linear_mps, message.angular_radps), header.stamp,
                           header.incarnation, self.clock.now())
        self.follow()
