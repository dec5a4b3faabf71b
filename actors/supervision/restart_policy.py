"""How often a process may be restarted: OTP's restart intensity, with backoff.

Up to `intensity` restarts within `period_s` happen at once; beyond half of them each waits
longer, doubling from `backoff_s`; one more than `intensity` and the policy gives up, which the
supervisor escalates to a safe stop. Pure: time is an argument.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field


@dataclass(slots=True)
class RestartPolicy:
    """Sliding window of restarts of one process. Times are in seconds of the caller's clock."""

    intensity: int = 50
    period_s: float = 60.0
    backoff_s: float = 0.05
    backoff_max_s: float = 2.0
    _restarts: deque[float] = field(default_factory=deque)

    def delay_s(self, now_s: float) -> float | None:
        """Return how long to wait before the next restart, or None to give up."""
        while self._restarts and now_s - self._restarts[0] > self.period_s:
            self._restarts.popleft()
        count = len(self._restarts)
        if count >= self.intensity:
            return None
        free = self.intensity // 2
        if count < free:
            return 0.0
        return float(min(self.backoff_s * 2 ** (count - free), self.backoff_max_s))

    def restarted(self, now_s: float) -> None:
        """Note a restart."""
        self._restarts.append(now_s)
