"""`Rate`: a topic comes too seldom or too often."""

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
"""Messages that are counted in a window; more are too often by any measure."""


class RateMonitor(Sustained):
    """Counts messages in a window that slides.

    Args:
        at_least_hz: lowest rate in order, messages per simulated second; 0 for any.
        at_most_hz: highest rate in order; infinite for any.
        window_s: over which they are counted.
        start_s: now.
        grace_s: how long the first message may take.
        known: whether idle may be claimed before anything was heard.
        clear_s: how long the rate has to be in order before it is idle again.
    """

    def __init__(self, at_least_hz: float, at_most_hz: float, window_s: float, start_s: float,
                 grace_s: float, *, known: bool = True, clear_s: float = 0.0) -> None:
        super().__init__(0.0, clear_s)
        self.known = known
        self._least, self._most = at_least_hz * window_s, at_most_hz * window_s
        self._window_s = window_s
        self._from_s = start_s + max(grace_s, window_s)
        self._is_first = True
        self._heard: deque[float] = deque(maxlen=_MOST)

    @property
    def due_s(self) -> float:
        """When a message leaves the window, the first one is full, or the rate is well for long."""
        leaves_s = self._heard[0] + self._window_s if self._heard else math.inf
        begins_s = self._from_s if self._is_first else math.inf
        well_s = self._well.since_s + self._well.enough_s if self.active else math.inf
        return min(leaves_s, begins_s, well_s)

    def heard(self, now_s: float) -> None:
        """Count a message."""
        self._heard.append(now_s)
        self.expire(now_s)

    def missed(self, now_s: float) -> None:
        """Begin to count again: messages may have been missed."""
        self._heard.clear()
        self._from_s, self._is_first = now_s + self._window_s, True

    def expire(self, now_s: float) -> None:
        """Forget what has left the window, and judge."""
        while self._heard and self._heard[0] <= now_s - self._window_s + 1e-9:
            self._heard.popleft()
        if now_s >= self._from_s - 1e-9:
            self._is_first = False
        count = len(self._heard)
        if count > self._most + 1e-9:
            self.note(f"{count} messages in {self._window_s:g} s, at most {self._most:g} are right",
                      now_s)
        elif count >= self._least - 1e-9:
            self.note("", now_s)
        elif not self._is_first:
            self.note(f"fewer than {self._least:g} messages in {self._window_s:g} s", now_s)


class Rate(DetectionModule):
    """Active while messages of a topic come too seldom or too often, by their arrival."""

    class Parameters(DetectionModule.Parameters, frozen=True, kw_only=True):
        """Which topic, and its rate.

        Attributes:
            topic: key of the topic.
            at_least_hz: messages per simulated second that there have to be.
            at_most_hz: that there may be.
            window_s: over which they are counted, s.
            clear_s: how long the rate has to be in order before the module is idle again, s.
            suspects: names of nodes to be respawned when it is active; none by default.
        """

        topic: TopicHeard
        at_least_hz: NonNegative = 0.0
        at_most_hz: Annotated[float, msgspec.Meta(gt=0)] = math.inf
        window_s: Positive = 1.0
        clear_s: NonNegative = 0.5
        suspects: Suspects = ()

        def __post_init__(self) -> None:
            """Refuse rates that allow all or nothing."""
            if not self.at_least_hz + (self.at_most_hz < math.inf) > 0:
                raise ValueError("at_least_hz: missing; give it, at_most_hz or both")
            if not self.at_least_hz < self.at_most_hz:
                raise ValueError("at_most_hz: must be greater than at_least_hz")
            if self.at_least_hz * self.window_s > _MOST / 2:
                raise ValueError(f"window_s: at most {_MOST // 2} messages are counted in it")

    parameters: Parameters

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        said = self.parameters
        self.monitor = self.judged_by(RateMonitor(
            said.at_least_hz, said.at_most_hz, said.window_s, self.clock.now(),
            self.grace_s(said.window_s), known=self.first_life, clear_s=said.clear_s))
        self.monitor.accused = said.suspects
        self.hear_topic(said.topic, self.heard)

    def missed(self) -> None:
        """Begin to count again."""
        self.monitor.missed(self.clock.now())

    def heard(self, _message: Any, header: Header) -> None:
        """Count a message."""
        self.note_absence()
        self.monitor.accused = self.accused(self.parameters.suspects, header)
        self.monitor.heard(self.clock.now())
        self.follow()
