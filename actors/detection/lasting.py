"""Since when something is so, and whether that is long enough: what monitors judge by."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(slots=True)
class Lasting:
    """Something that counts when it has lasted. Times are simulated seconds.

    Args:
        enough_s: how long it has to last.
        since_s: since when it is so; infinite while it is not.
    """

    enough_s: float
    since_s: float = math.inf

    def note(self, is_so: bool, now_s: float) -> bool:
        """Take note of whether it is so now; return whether it has lasted for long enough."""
        self.since_s = min(self.since_s, now_s) if is_so else math.inf
        return now_s - self.since_s >= self.enough_s - 1e-9

    def forget(self) -> None:
        """Begin anew."""
        self.since_s = math.inf
