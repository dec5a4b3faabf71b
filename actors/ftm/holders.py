"""Holders of something that is in force while there is one: the brake, a bound on the pilot. Pure.

A holder that is not a recovery module of the system is obeyed too: an unneeded brake costs a
mission, a missing one may cost more. But no recovery of the system releases it. So it is reported
as unknown, and an operator can release it (`rampart reset NAME`). Unknown holders beyond a limit
count as one, `OTHERS`.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Generic, TypeVar

V = TypeVar("V")

OTHERS = "others"
"""Stands for all unknown holders above `UNKNOWN`; only an operator releases it."""

UNKNOWN = 16
"""Most unknown holders that are distinguished."""


class Holders(Generic[V], dict[str, V]):
    """What each holder holds, by name.

    Args:
        known: Names of the recovery modules of the system; None if no holder counts as unknown.
        crowded: What `OTHERS` holds: the strictest value.
    """

    def __init__(self, known: Collection[str] | None, crowded: V) -> None:
        super().__init__()
        self._known = known if known is None else frozenset(known)
        self._crowded = crowded

    @property
    def unknown(self) -> tuple[str, ...]:
        """Holders that are not recovery modules of the system."""
        return tuple(filter(self.is_unknown, self))

    def is_unknown(self, name: str) -> bool:
        """Whether a name is not that of a recovery module of the system."""
        return self._known is not None and name not in self._known

    def hold(self, name: str, value: V) -> None:
        """Note a holder, and replace what it held."""
        if name in self or not self.is_unknown(name) or len(self.unknown) < UNKNOWN:
            self[name] = value
        else:
            self[OTHERS] = self._crowded

    def let_go(self, name: str) -> None:
        """Release what a holder holds, if anything."""
        if name != OTHERS:
            self.pop(name, None)

    def reset(self, name: str) -> bool:
        """Release what an unknown holder holds; return whether it held anything."""
        return self.is_unknown(name) and self.pop(name, None) is not None
