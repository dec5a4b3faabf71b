"""Freshness of a stream of samples, judged by the time at which their content was true.

The age of a sample counts from its stamp, not from its arrival: a frozen source that repeats an
old sample, and a link that delivers each sample seconds late, are as stale as silence.
"""

from __future__ import annotations

import math

from rampart.actors.bus.plausible import is_possible


class FreshnessMonitor:
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
    """

    def __init__(self, subject: str, timeout_s: float, hold_s: float, start_s: float,
                 grace_s: float, *, known: bool = True) -> None:
        self.subject = subject
        self.nodes: tuple[str, ...] = ()
        self.timeout_s = timeout_s
        self.hold_s = hold_s
        self.active = False
        self.reason = ""
        self._known = known
        self._newest_s = -math.inf
        self._first_due_s = start_s + grace_s
        self._fresh_since_s: float | None = None

    @property
    def known(self) -> bool:
        """Whether anything fresh was heard, or missed.

        Content that is old already says no more than that something is wrong: idle may not be
        claimed, and `expire` makes it active.
        """
        return self._known or self.active

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
        self._known = True
        if not self.active:
            return
        if self._fresh_since_s is None:
            self._fresh_since_s = now_s
        elif now_s >= self._fresh_since_s + self.hold_s - 1e-9:
            self.active = False
            self.reason = ""
            self._fresh_since_s = None

    def expire(self, now_s: float) -> None:
        """Conclude from the time that has passed."""
        if now_s >= self._stale_s:
            self._fresh_since_s = None
            if not self.active:
                self.active = True
                self.reason = f"{self.subject} not updated for {self.timeout_s:g} s" \
                    if self._newest_s > -math.inf else f"{self.subject} never heard"
