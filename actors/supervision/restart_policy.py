"""How often a process may be restarted: OTP's restart intensity, with backoff.

Up to half of `intensity` restarts within `period_s` happen at once; beyond that each waits longer,
doubling from `backoff_s`; one more than `intensity` and the policy gives up. What has crashed so
often may yet be well again later, when a disk has room or a device is plugged in. So giving up is
no end: single attempts follow, further and further apart, and only if one of them lasts for a whole
period is the process as good as any other again. Pure: time is an argument.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field


@dataclass(slots=True)
class RestartPolicy:
    """Sliding window of restarts of one process. Times are in seconds of the caller's clock.

    Attributes:
        attempts: Single ones since it gave up; 0 while it has not.
    """

    intensity: int = 50
    period_s: float = 60.0
    backoff_s: float = 0.05
    backoff_max_s: float = 2.0
    attempt_s: float = 10.0
    attempt_max_s: float = 60.0
    attempts: int = 0
    _restarts: deque[float] = field(default_factory=deque)

    def delay_s(self, now_s: float) -> float | None:
        """Return how long to wait before the next restart, or None to give up."""
        while self._restarts and now_s - self._restarts[0] > self.period_s:
            self._restarts.popleft()
        count = len(self._restarts)
        if count == 0:
            self.attempts = 0
        if count >= self.intensity or self.attempts:
            return None
        free = self.intensity // 2
        if count < free:
            return 0.0
        return float(min(self.backoff_s * 2 ** (count - free), self.backoff_max_s))

    def attempt_in_s(self, now_s: float) -> float:
        """Return how long to wait before the next attempt of what was given up.

        Until the window has room for it, and longer after each that failed.
        """
        pause_s = min(self.attempt_s * 2.0 ** min(self.attempts, 20), self.attempt_max_s)
        self.attempts += 1
        if len(self._restarts) < self.intensity:
            return pause_s
        return max(pause_s, self._restarts[-self.intensity] + self.period_s - now_s)

    def restarted(self, now_s: float) -> None:
        """Note a restart."""
        self._restarts.append(now_s)
