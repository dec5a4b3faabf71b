"""`Rate`: messages of a topic arrive too seldom or too often."""

from __future__ import annotations

import math
from collections import deque
from typing import Annotated, Any

import msgspec

from rampart.actors.detection.finding import Sustained
from rampart.actors.detection.module import DetectionModule
from rampart.actors.runtime.actor import Context, Header
from rampart.actors.runtime.parameters import Suspects, TopicHeard
from rampart.manager.spec.tables import NonNegative, Positive

_MOST = 10_000
"""Most messages that are counted in a window."""


class RateMonitor(Sustained):
    """Counts messages in a sliding window.

    Args:
        at_least_hz: Lowest permitted rate, messages per simulated second; 0 for any.
        at_most_hz: Highest permitted rate; infinite for any.
        window_s: Length of the window.
        start_s: Present time.
        grace_s: How long the first message may take.
        known: Whether to report idle before any input.
        clear_s: How long the rate has to be permitted before it is idle again.
    """

    def __init__(self, at_least_hz: float, at_most_hz: float, window_s: float, start_s: float,
                 grace_s: float, *, known: bool = True, clear_s: float = 0.0) -> None:
        super().__init__(0.0, clear_s)
        self.known = known
        self._least, self._most = at_least_hz * window_s, at_most_hz * window_s
        self._window_s = window_s
        self._from_s = start_s + max(grace_s, window_s)
        self._is_first = True
        self._arrivals: deque[float] = deque(maxlen=_MOST)

    @property
    def due_s(self) -> float:
        """When a message leaves the window, the first window is full, or `clear_s` is over."""
        leaves_s = self._arrivals[0] + self._window_s if self._arrivals else math.inf
        begins_s = self._from_s if self._is_first else math.inf
        well_s = self._well.since_s + self._well.enough_s if self.active else math.inf
        return min(leaves_s, begins_s, well_s)

    def heard(self, now_s: float) -> None:
        """Count a message."""
        self._arrivals.append(now_s)
        self.expire(now_s)

    def missed(self, now_s: float) -> None:
        """Start to count again, since messages may have been missed."""
        self._arrivals.clear()
        self._from_s, self._is_first = now_s + self._window_s, True

    def expire(self, now_s: float) -> None:
        """Forget the messages that have left the window, and decide."""
        while self._arrivals and self._arrivals[0] <= now_s - self._window_s + 1e-9:
            self._arrivals.popleft()
        if now_s >= self._from_s - 1e-9:
            self._is_first = False
        count = len(self._arrivals)
        if count > self._most + 1e-9:
            self.note(f"{count} messages in {self._window_s:g} s, expected at most {self._most:g}",
                      now_s)
        elif count >= self._least - 1e-9:
            self.note("", now_s)
        elif not self._is_first:
            self.note(f"fewer than {self._least:g} messages in {self._window_s:g} s", now_s)


class Rate(DetectionModule):
    """Active while messages of a topic arrive too seldom or too often."""

    class Parameters(DetectionModule.Parameters, frozen=True, kw_only=True):
        """Topic and permitted rate.

        Attributes:
            topic: key of the topic.
            at_least_hz: lowest permitted rate, messages per simulated second.
            at_most_hz: highest permitted rate.
            window_s: length of the window in which messages are counted, s.
            clear_s: how long the rate has to be permitted before the module is idle again, s.
            suspects: nodes to be respawned while it is active; none by default.
        """

        topic: TopicHeard
        at_least_hz: NonNegative = 0.0
        at_most_hz: Annotated[float, msgspec.Meta(gt=0)] = math.inf
        window_s: Positive = 1.0
        clear_s: NonNegative = 0.5
        suspects: Suspects = ()

        def __post_init__(self) -> None:
            """Refuse rates that permit everything or nothing."""
            if not self.at_least_hz + (self.at_most_hz < math.inf) > 0:
                raise ValueError("at_least_hz: missing; give it, at_most_hz or both")
            if not self.at_least_hz < self.at_most_hz:
                raise ValueError("at_most_hz: must be greater than at_least_hz")
            if self.at_least_hz * self.window_s > _MOST / 2:
                raise ValueError(f"window_s: at most {_MOST // 2} messages are counted in it")

    parameters: Parameters

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        chosen = self.parameters
        self.monitor = self.judged_by(RateMonitor(
            chosen.at_least_hz, chosen.at_most_hz, chosen.window_s, self.clock.now(),
            self.grace_s(chosen.window_s), known=self.first_life, clear_s=chosen.clear_s))
        self.monitor.accused = chosen.suspects
        self.hear_topic(chosen.topic, self.heard)

    def missed(self) -> None:
        """Start to count again."""
        self.monitor.missed(self.clock.now())

    def heard(self, _message: Any, header: Header) -> None:
        """Count a message."""
        self.note_absence()
        self.monitor.accused = self.accused(self.parameters.suspects, header)
        self.monitor.heard(self.clock.now())
        self.follow()
