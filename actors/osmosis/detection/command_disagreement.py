"""DM9: command calculation error, by comparison of Osmosis Control with its hot standby.

The comparison cannot identify the wrong instance. It names the one with the cheaper restart first,
and the other one if they still disagree after that restart. Meanwhile the Safety Pilot drives the
safer values (`rampart.actors.osmosis.control.pilot.command_pair`).

A wrong turn rate leads out of the lane, so it is detected soon. Speeds may differ while a restarted
follower accelerates; the slower one drives meanwhile.
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


class ComparisonLimits(msgspec.Struct, frozen=True):
    """Limits of agreement.

    Args:
        linear_mps: tolerated difference of speeds.
        angular_radps: tolerated difference of turn rates.
        linear_s: longest difference of speeds; more than the ramp of a restarted follower.
        angular_s: longest difference of turn rates.
        hold_s: time that they must have agreed again.
        fresh_s: greatest age of a compared command.
        forget_s: time without a comparison that ends the finding; other modules detect silence.
    """

    linear_mps: float = 0.25
    angular_radps: float = 0.35
    linear_s: float = 2.0
    angular_s: float = 0.4
    hold_s: float = 0.5
    fresh_s: float = 0.2
    forget_s: float = 3.0


@dataclass(slots=True)
class _Source:
    """Newest command of one instance."""

    linear_mps: float = 0.0
    angular_radps: float = 0.0
    stamp_s: float = -math.inf
    incarnation: int = 0


class CommandComparison(Finding):
    """Active while two instances disagree; names one, then the other.

    Args:
        sources: names of the nodes in the order in which they are named.
        limits: limits of agreement.
        known_after_s: time from which it may be idle without input; -inf for at once.
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
        """Time at which a finding without comparison ends."""
        return self._compared_s + self.limits.forget_s if self.active else super().due_s

    def expire(self, now_s: float) -> None:
        """End a finding without comparison."""
        super().expire(now_s)
        if now_s >= self._compared_s + self.limits.forget_s:
            self.clear()

    def take(self, source: str, command: tuple[float, float], stamp_s: float, incarnation: int,
             now_s: float) -> None:
        """Take a command, (m/s, rad/s), of the time `stamp_s`, and compare."""
        sender = self._sources[source]
        if incarnation != sender.incarnation:
            sender.incarnation = incarnation
            self._linear.forget()
            self._angular.forget()
        if not all(map(math.isfinite, command)) or not is_possible(stamp_s, now_s):
            return  # other modules detect invalid commands
        sender.linear_mps, sender.angular_radps = command
        sender.stamp_s = stamp_s
        a, b = self._sources.values()
        if now_s - min(a.stamp_s, b.stamp_s) <= self.limits.fresh_s:
            self._compare(a, b, now_s)

    def _compare(self, a: _Source, b: _Source, now_s: float) -> None:
        limits = self.limits
        self.known = True
        self._compared_s = now_s
        faster = abs(a.linear_mps - b.linear_mps) > limits.linear_mps
        turning = abs(a.angular_radps - b.angular_radps) > limits.angular_radps
        # Both timers run: `or` would skip the second.
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
"""Time that a restarted module waits for two commands before it reports idle."""


class CommandDisagreement(DetectionModule):
    """Active while Osmosis Control and its standby disagree; names the one to restart."""

    class Parameters(DetectionModule.Parameters, frozen=True):
        """Parameters.

        Attributes:
            suspects: the two nodes in the order in which they are named; by default the standby
                first, whose restart costs nothing.
        """

        suspects: NodeNames = ("standby_control", "osmosis_control")

        def __post_init__(self) -> None:
            """Check the names."""
            if not len(set(self.suspects)) == len(self.suspects) == 2 \
                    or "osmosis_control" not in self.suspects:
                raise ValueError("suspects: expected osmosis_control and its standby")

    parameters: Parameters

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        first, second = self.parameters.suspects
        self._standby = second if first == "osmosis_control" else first
        self.monitor = self.judged_by(CommandComparison(
            (first, second), known_after_s=self.known_after_s(_FIRST_PAIR_S)))

    @on(topics.COMMAND)
    def command(self, message: m.Twist, header: Header) -> None:
        """Take the active command."""
        self._take("osmosis_control", message, header)

    @on(topics.STANDBY_COMMAND)
    def standby(self, message: m.Twist, header: Header) -> None:
        """Take the standby's command."""
        self._take(self._standby, message, header)

    def _take(self, source: str, message: m.Twist, header: Header) -> None:
        self.monitor.take(source, (message.linear_mps, message.angular_radps), header.stamp,
                          header.incarnation, self.clock.now())
        self.follow()
