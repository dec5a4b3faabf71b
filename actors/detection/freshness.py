"""DM2 and DM6: command not updated, localization not updated (paper, table I); of any topic.

The age of a sample counts from its stamp, when its content was true, not from its arrival. A frozen
source that repeats an old sample, and a link that delivers seconds late, are as stale as silence.
"""

from __future__ import annotations

import math
from typing import Any

from rampart.actors.detection.finding import Sustained
from rampart.actors.detection.module import DetectionModule
from rampart.actors.ftm.plausible import is_possible
from rampart.actors.runtime.actor import Context, Header
from rampart.actors.runtime.parameters import ControlTimeout, Suspects, TopicHeard
from rampart.manager.spec.tables import NonNegative


class FreshnessMonitor(Sustained):
    """Active while the newest content is older than the timeout.

    It becomes idle with a sample after content has been fresh for `hold_s` without a break. So
    neither a single sample nor a stuttering source makes it flap. A sample that is already old does
    not make it idle.

    Args:
        subject: Name of the content, for the reason: "command".
        timeout_s: Greatest admissible age, s.
        hold_s: How long it must have been fresh again, s.
        start_s: Present time.
        grace_s: How long the first sample may take, s.
        known: Whether to report idle before any input.
    """

    def __init__(self, subject: str, timeout_s: float, hold_s: float, start_s: float,
                 grace_s: float, *, known: bool = True) -> None:
        super().__init__(0.0, hold_s)
        self.known = known
        self._subject, self._timeout_s = subject, timeout_s
        self._newest_s = -math.inf
        self._stale_s = start_s + grace_s

    @property
    def due_s(self) -> float:
        """When the content is too old."""
        is_over = self.active and self._well.since_s == math.inf
        return math.inf if is_over else self._stale_s

    def heard(self, stamp_s: float, now_s: float) -> None:
        """Note a sample.

        Args:
            stamp_s: When its content was true. A stamp that is not a number, or in the future, does
                not count: a frozen source with a wrong clock is not fresh.
            now_s: Present time.
        """
        if not is_possible(stamp_s, now_s) or not stamp_s > self._newest_s:
            return
        self._newest_s = min(stamp_s, now_s)
        self._stale_s = self._newest_s + self._timeout_s
        if now_s < self._stale_s:
            self.note("", now_s)

    def expire(self, now_s: float) -> None:
        """Conclude from the time without an event."""
        if now_s >= self._stale_s:
            self.note(f"{self._subject} not updated for {self._timeout_s:g} s"
                      if self._newest_s > -math.inf else f"{self._subject} never heard", now_s)


class Freshness(DetectionModule):
    """Active while the newest content of a topic is too old."""

    class Parameters(DetectionModule.Parameters, frozen=True, kw_only=True):
        """Topic, limits, and suspects.

        Attributes:
            topic: key of the topic.
            timeout_s: greatest admissible age of the content, s.
            subject: name of the content, for the reason; the topic's key if left out.
            hold_s: how long it must be fresh again before the module is idle, s.
            suspects: nodes to be respawned while it is active, as a rule the publisher of the
                topic; none by default, as in the paper.
        """

        topic: TopicHeard
        timeout_s: ControlTimeout
        subject: str = ""
        hold_s: NonNegative = 0.2
        suspects: Suspects = ()

    parameters: Parameters

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        said = self.parameters
        self.monitor = self.judged_by(FreshnessMonitor(
            said.subject or said.topic, said.timeout_s, said.hold_s, self.clock.now(),
            self.grace_s(said.timeout_s), known=self.first_life))
        self.monitor.accused = said.suspects
        self.hear_topic(said.topic, self.heard)

    def heard(self, _message: Any, header: Header) -> None:
        """Note a sample."""
        self.monitor.heard(header.stamp, self.clock.now())
        self.monitor.accused = self.accused(self.parameters.suspects, header)
        self.follow()
