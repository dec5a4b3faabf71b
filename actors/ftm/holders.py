"""What is in force as long as there is a holder: the brake, a bound on the pilot.

A holder that is not a recovery module of the system is obeyed all the same: its brake costs
a mission, one that is not applied may cost more. But no recovery of the system will ever let go for
it, so it is named as unknown, and an operator can let go in its place
(`rampart reset NAME`). Of unknown holders so many are told apart; all above them are one, `OTHERS`.
Pure.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Generic, TypeVar

V = TypeVar("V")

OTHERS = "others"
"""Holds for all unknown holders above `UNKNOWN`; only an operator lets go for it."""

UNKNOWN = 16
"""Unknown holders that are told apart."""


class Holders(Generic[V], dict[str, V]):
    """What each holder holds, by its name.

    Args:
        known: names of the recovery modules of the system; None if they are not known, and then
            no holder counts as unknown.
        crowded: what `OTHERS` holds: the strictest there is.
    """

    def __init__(self, known: Collection[str] | None, crowded: V) -> None:
        super().__init__()
        self._known = known if known is None else frozenset(known)
        self._crowded = crowded

    @property
    def unknown(self) -> tuple[str, ...]:
        """The holders that are no recovery modules of the system."""
        return tuple(filter(self.is_unknown, self))

    def is_unknown(self, name: str) -> bool:
        """Whether a name is that of no recovery module of the system."""
        return self._known is not None and name not in self._known

    def hold(self, name: str, value: V) -> None:
        """Note a holder; what it held before is replaced."""
        if name in self or not self.is_unknown(name) or len(self.unknown) < UNKNOWN:
            self[name] = value
        else:
            self[OTHERS] = self._crowded

    def let_go(self, name: str) -> None:
        """Have a holder let go; a holder that holds nothing changes nothing."""
        if name != OTHERS:
            self.pop(name, None)

    def reset(self, name: str) -> bool:
        """Let go in the place of an unknown holder; return whether there was anything to do."""
        return self.is_unknown(name) and self.pop(name, None) is not None
