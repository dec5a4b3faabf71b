"""Parts of monitors: a condition that lasts, a finding with its reason and the accused. Pure."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass


@dataclass(slots=True)
class Lasting:
    """A condition that counts after some time. Times are simulated seconds.

    Args:
        enough_s: How long it has to last.
        since_s: Since when it holds; infinite while it does not.
    """

    enough_s: float
    since_s: float = math.inf

    def note(self, is_so: bool, now_s: float) -> bool:
        """Note whether it holds now; return whether it has lasted long enough."""
        self.since_s = min(self.since_s, now_s) if is_so else math.inf
        return now_s - self.since_s >= self.enough_s - 1e-9

    def forget(self) -> None:
        """Start again."""
        self.since_s = math.inf


class Finding:
    """Finding of a monitor: active while there is a reason.

    Args:
        known_after_s: When to report idle without any input; -inf for at once.

    Attributes:
        reason: Why it is active; "" while idle.
        nodes: The accused.
        known: Whether enough was received, or missed, to decide.
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
        """When the wait for a first input ends."""
        return math.inf if self.known else self._known_after_s

    def expire(self, now_s: float) -> None:
        """Give up waiting for a first input; its absence is the subject of other modules."""
        self.known = self.known or now_s >= self._known_after_s

    def clear(self) -> None:
        """Become idle and accuse no node."""
        self.reason = ""
        self.nodes = ()


class Recurrent(Finding):
    """Active from the `count`-th event within `within_s`, until there was none for `clear_s`.

    Args:
        count: How many events make it active.
        within_s: Within how long, simulated seconds.
        clear_s: How long without an event until it is idle again.
        known_after_s: When to report idle without any input; -inf for at once.

    Attributes:
        accused: Nodes to name while it is active; set by the owner.
    """

    def __init__(self, count: int, within_s: float, clear_s: float,
                 known_after_s: float = -math.inf) -> None:
        super().__init__(known_after_s)
        self._within_s, self._clear_s = within_s, clear_s
        self._events: deque[float] = deque(maxlen=count)
        self.accused: tuple[str, ...] = ()

    @property
    def due_s(self) -> float:
        """When it is idle again, or the wait for a first input ends."""
        return self._events[-1] + self._clear_s if self.active else super().due_s

    def happened(self, what: str, now_s: float) -> None:
        """Note an event, with its description."""
        self._events.append(now_s)
        count = self._events.maxlen
        if len(self._events) == count and now_s - self._events[0] <= self._within_s:
            self.known, self.nodes = True, self.accused
            self.reason = what if count == 1 else (
                f"{count} within {self._within_s:g} s, the last: {what}")

    def expire(self, now_s: float) -> None:
        """Conclude from the time without an event."""
        super().expire(now_s)
        if self.active and now_s >= self.due_s - 1e-9:
            self.clear()


class Sustained(Finding):
    """Active when an error has lasted for `for_s`, until its absence has lasted for `clear_s`.

    The last note stands until the next one. So an error and then silence make it active, but a
    correct value and then silence do not make it idle.

    Args:
        for_s: How long the error has to last, simulated seconds.
        clear_s: How long its absence has to last.
        known_after_s: When to report idle without any input; -inf for at once.

    Attributes:
        accused: Nodes to name when it becomes active; set by the owner.
    """

    def __init__(self, for_s: float, clear_s: float, known_after_s: float = -math.inf) -> None:
        super().__init__(known_after_s)
        self._wrong, self._well = Lasting(for_s), Lasting(clear_s)
        self._why = ""
        self.accused: tuple[str, ...] = ()

    @property
    def due_s(self) -> float:
        """When the error has lasted, or the wait for a first input ends."""
        lasted_s = math.inf if self.active else self._wrong.since_s + self._wrong.enough_s
        return min(lasted_s, super().due_s)

    def note(self, why: str, now_s: float) -> None:
        """Note the present error, "" for none."""
        self._why = why
        lasted = self._wrong.note(bool(why), now_s)
        cured = self._well.note(not why, now_s)
        # Idle during an error that may yet last would release the recovery that acts against it.
        self.known = self.known or lasted or not why
        if lasted and not self.active:
            self.reason, self.nodes = why, self.accused
        elif cured and self.active:
            self.clear()

    def expire(self, now_s: float) -> None:
        """Conclude from the time without an event."""
        super().expire(now_s)
        if self._why:
            self.note(self._why, now_s)

    def doubt(self) -> None:
        """Note that nothing is known now; both times start again."""
        self._why = ""
        self._wrong.forget()
        self._well.forget()
