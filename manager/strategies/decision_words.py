"""Decisions of the FTM Manager in plain words, for people who know the mechanisms' names."""

from __future__ import annotations

from collections.abc import Sequence

from rampart.manager.strategies.registry import STRATEGIES


def decision_in_words(active: Sequence[str], rule: int, recoveries: Sequence[str],
                      strategy: str = "safety-first") -> str:
    """Return one sentence: what is active, what is done about it, and by which rule.

    Of a strategy that is not known here (a recording may name one) the rule has a number only.
    """
    if not active and recoveries:
        return (f"No mechanism is active any more; {listing(recoveries)} "
                f"{'stays' if len(recoveries) == 1 else 'stay'} in force until reset.")
    if not active:
        return "No mechanism is active: there is nothing to recover from."
    verb = "is" if len(active) == 1 else "are"
    taken = f"run {listing(recoveries)}" if recoveries else "no recovery"
    known = STRATEGIES.get(strategy)
    reason = known.rules.get(rule) if known else None
    because = f", because {reason}" if reason else ""
    block = f"block {rule}" if strategy == "safety-first" else f"{strategy}, rule {rule}"
    return f"{listing(active)} {verb} active: {taken}{because} ({block})."


def listing(names: Sequence[str]) -> str:
    """Return names as "A", "A and B" or "A, B and C"; "nothing" if there are none."""
    return " and ".join(filter(None, (", ".join(names[:-1]), *names[-1:]))) or "nothing"
