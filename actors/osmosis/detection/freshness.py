"""DM2 and DM6: command not updated, localization not updated (paper, table I).

A stream of samples is judged by the time at which their content was true. The age of a sample
counts from its stamp, not from its arrival: a frozen source that repeats an old sample, and a link
that delivers each sample seconds late, are as stale as silence.
"""

from __future__ import annotations

import math
from typing import Literal

from rampart.actors.bus.plausible import is_possible
from rampart.actors.detection.module import DetectionModule, Waiting
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.detection.finding import Finding
from rampart.actors.runtime.actor import Context, Header, on
from rampart.actors.runtime.parameters import ControlTimeout, NodeNames
from rampart.manager.spec.tables import NonNegative


class FreshnessMonitor(Finding):
    """Active while the newest content is older than the timeout.

    It becomes idle again with a sample that comes after content has been fresh for `hold_s`
    without interruption. So neither a single sample nor a source that stutters makes it flap.

    Args:
        subject: what is monitored, for the reason: "command".
        timeout_s: greatest admissible age, s.
        hold_s: how long it must have been fresh again, s.
        start_s: now.
        grace_s: how long the first sample may take, s.
        known: whether idle may be claimed before anything was heard.

    Attributes:
        nodes: whom to suspect; up to the owner.
        known: whether anything fresh was heard, or missed. Content that is old already says no
            more than that something is wrong: idle may not be claimed, and `expire` makes it
            active.
    """

    def __init__(self, subject: str, timeout_s: float, hold_s: float, start_s: float,
                 grace_s: float, *, known: bool = True) -> None:
        super().__init__(-math.inf if known else math.inf)
        self.subject = subject
        self.timeout_s = timeout_s
        self.hold_s = hold_s
        self._newest_s = -math.inf
        self._first_due_s = start_s + grace_s
        self._fresh_since_s: float | None = None

    @property
    def due_s(self) -> float:
        """When time alone changes the finding."""
        return math.inf if self.active and self._fresh_since_s is None else self._stale_s

    @property
    def _stale_s(self) -> float:
        if self._newest_s == -math.inf:
            return self._first_due_s
        return self._newest_s + self.timeout_s

    def heard(self, stamp_s: float, now_s: float) -> None:
        """Take note of a sample.

        Args:
            stamp_s: when its content was true. A stamp from the future, or one that is not a
                number, counts as nothing: a frozen source with a wrong clock is not fresh.
            now_s: now.
        """
        if not is_possible(stamp_s, now_s) or not stamp_s > self._newest_s:
            return
        self._newest_s = min(stamp_s, now_s)
        if now_s >= self._stale_s:
            return
        self.known = True
        if not self.active:
            return
        if self._fresh_since_s is None:
            self._fresh_since_s = now_s
        elif now_s >= self._fresh_since_s + self.hold_s - 1e-9:
            self.reason = ""
            self._fresh_since_s = None

    def expire(self, now_s: float) -> None:
        """Conclude from the time that has passed."""
        if now_s >= self._stale_s:
            self._fresh_since_s = None
            self.known = True
            if not self.active:
                self.reason = f"{self.subject} not updated for {self.timeout_s:g} s" \
                    if self._newest_s > -math.inf else f"{self.subject} never heard"


class Freshness(DetectionModule):
    """Active while a topic is stale. A subclass per topic, so that each hears only its own.

    Class attributes:
        subject: what is stale, for the reason.
    """

    class Parameters(Waiting, frozen=True):
        """What is stale, and who is named then.

        Attributes:
            timeout_s: greatest admissible age of the content, s.
            hold_s: how long it must be fresh again before the module is idle, s.
            suspects: names of nodes to be respawned when it is active, as a rule the one that
                publishes the topic; none by default, as in the paper.
            topic: says again what the class says, for readers of the spec.
        """

        timeout_s: ControlTimeout = 1.0
        hold_s: NonNegative = 0.2
        suspects: NodeNames = ()

    parameters: Parameters
    subject = ""

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        if not self.subject:
            raise ValueError(f"{self.name}: actor Freshness hears no topic; name a subclass, "
                             "CommandFreshness or LocalizationFreshness")
        timeout_s = self.parameters.timeout_s
        self.monitor = self.judged_by(FreshnessMonitor(
            self.subject, timeout_s, self.parameters.hold_s, self.clock.now(),
            self.grace_s(timeout_s), known=self.first_life))
        self.monitor.nodes = self._suspects = self.parameters.suspects

    def sample(self, header: Header) -> None:
        """Take note of a sample."""
        monitor = self.monitor
        monitor.heard(header.stamp, self.clock.now())
        if self._suspects and not monitor.active:
            # The life that was last heard is accused: a later one has done nothing yet.
            monitor.nodes = tuple(
                f"{name}#{header.incarnation}" if name == header.source else name
                for name in self._suspects)
        self.follow()


class CommandFreshness(Freshness):
    """DM2: Osmosis Control's command is not updated (0.64 s in the authors' code)."""

    class Parameters(Freshness.Parameters, frozen=True):
        """As of `Freshness`."""

        timeout_s: ControlTimeout = 0.64
        topic: Literal["control/command"] = "control/command"

    subject = "command"

    @on(topics.COMMAND)
    def command(self, _message: m.Twist, header: Header) -> None:
        """Hear a command."""
        self.sample(header)


class LocalizationFreshness(Freshness):
    """DM6: the pose is not updated (1 s in the authors' code)."""

    class Parameters(Freshness.Parameters, frozen=True):
        """As of `Freshness`."""

        topic: Literal["localization/pose"] = "localization/pose"

    subject = "localization"

    @on(topics.POSE)
    def pose(self, _message: m.Pose, header: Header) -> None:
        """Hear a pose."""
        self.sample(header)
