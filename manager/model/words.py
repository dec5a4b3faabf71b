"""Decisions of the FTM Manager in plain words, for people who know the mechanisms' names."""

from __future__ import annotations

from collections.abc import Sequence

_BLOCKS = {
    1: "it is the only active mechanism",
    2: "one active mechanism dominates all the others in the FTM tree",
    3: "one of the recoveries in question is safer than all the others",
    4: "no mechanism and no recovery dominates, so the lowest common dominant decides",
}
"""The blocks of the safety-first strategy (paper, figure 7)."""


def decision_in_words(
    active: Sequence[str], rule: int, recoveries: Sequence[str], strategy: str = "safety-first",
    because: str = "",
) -> str:
    """Return one sentence: what is active, what is done about it, and by which rule.

    `because` says the rule of a strategy other than safety-first in words, where they are known.
    """
    if not active and recoveries:
        return (f"No mechanism is active any more; {listing(recoveries)} "
                f"{'stays' if len(recoveries) == 1 else 'stay'} in force until reset.")
    if not active:
        return "No mechanism is active: there is nothing to recover from."
    verb = "is" if len(active) == 1 else "are"
    taken = f"run {listing(recoveries)}" if recoveries else "no recovery"
    sentence = f"{listing(active)} {verb} active: {taken}"
    if strategy == "safety-first" and rule in _BLOCKS:
        return f"{sentence}, because {_BLOCKS[rule]} (block {rule})."
    if because:
        return f"{sentence}, because {because} ({strategy}, rule {rule})."
    return f"{sentence} (strategy {strategy}, rule {rule})."


def listing(names: Sequence[str]) -> str:
    """Return names as "A", "A and B" or "A, B and C"; "nothing" if there are none."""
    if not names:
        return "nothing"
    if len(names) == 1:
        return names[0]
    return f"{', '.join(names[:-1])} and {names[-1]}"
