"""What monitors have in common: a reason, the accused, and a wait for the first input. Pure."""

from __future__ import annotations

import math


class Finding:
    """What a monitor has found: active for as long as there is a reason.

    Args:
        known_after_s: when idle may be claimed without anything heard; -inf for at once.

    Attributes:
        reason: why it is active; "" while it is idle.
        nodes: the accused.
        known: whether enough was heard, or missed, to say either.
    """

    def __init__(self, known_after_s: float = -math.inf) -> None:
        self.reason = ""
        self.nodes: tuple[str, ...] = ()
        self.known = known_after_s == -math.inf
        self._known_after_s = known_after_s

    @property
    def active(self) -> bool:
        """Whether there is a reason."""
        return bool(self.reason)

    @property
    def due_s(self) -> float:
        """When time alone may change the finding: the wait for a first input ends."""
        return math.inf if self.known else self._known_after_s

    def expire(self, now_s: float) -> None:
        """Give up waiting for a first input: its absence is the subject of other modules."""
        self.known = self.known or now_s >= self._known_after_s

    def clear(self) -> None:
        """Go idle; nobody is accused."""
        self.reason = ""
        self.nodes = ()
