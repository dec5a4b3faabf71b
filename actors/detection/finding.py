"""What monitors have in common: a reason, the accused, how long something lasts. Pure."""

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
        """Begin again."""
        self.since_s = math.inf


class Finding:
    """What a monitor has found: active for as long as there is a reason.

    Args:
        known_after_s: when idle may be claimed without anything heard; -inf for at once.

    Attributes:
        reason: why it is active; "" while it is idle.
        nodes: the accused.
        known: whether enough was received, or missed, to decide.
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
        """Go idle and accuse no node any more."""
        self.reason = ""
        self.nodes = ()


class Sustained(Finding):
    """Active when something has been wrong for `for_s`, until all has been well for `clear_s`.

    What was noted last stands until something else is: a source that publishes something wrong and
    then nothing makes it active, a source that publishes something right and then nothing does not
    make it idle.

    Args:
        for_s: how long it has to be wrong, simulated seconds.
        clear_s: how long it has to be well again.
        known_after_s: when idle may be claimed without anything heard; -inf for at once.

    Attributes:
        accused: whom to name when it becomes active; up to the owner.
    """

    def __init__(self, for_s: float, clear_s: float, known_after_s: float = -math.inf) -> None:
        super().__init__(known_after_s)
        self._wrong, self._well = Lasting(for_s), Lasting(clear_s)
        self._why = ""
        self.accused: tuple[str, ...] = ()

    @property
    def due_s(self) -> float:
        """When what is wrong has lasted, or the wait for a first input ends."""
        lasted_s = math.inf if self.active else self._wrong.since_s + self._wrong.enough_s
        return min(lasted_s, super().due_s)

    def note(self, why: str, now_s: float) -> None:
        """Take note of what is wrong now, "" if all is well."""
        self.known = True
        self._why = why
        lasted = self._wrong.note(bool(why), now_s)
        cured = self._well.note(not why, now_s)
        if lasted and not self.active:
            self.reason, self.nodes = why, self.accused
        elif cured and self.active:
            self.clear()

    def expire(self, now_s: float) -> None:
        """Conclude from the time that has passed."""
        super().expire(now_s)
        if self._why:
            self.note(self._why, now_s)

    def doubt(self) -> None:
        """Take note that nothing is known now: what lasted until now begins again."""
        self._why = ""
        self._wrong.forget()
        self._well.forget()
