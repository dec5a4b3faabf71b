"""The strategies by name, decisions by them, and a decision in words.

A system spec names its strategy. Each has its own file:

* `safety-first`: the paper's, block by block;
* `mission-first`: the deepest barrier first, climbing the FTMTree when it takes too long;
* `simultaneous`: all maximal recoveries that can run together;
* `guarded-repair`: as safe as each mechanism asks for, with the repairs running beneath.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from types import MappingProxyType

from rampart.manager.model.mechanisms import Mechanisms
from rampart.manager.model.order import PartialOrder, Tree
from rampart.manager.strategies.arrangement import Arrangement
from rampart.manager.strategies.decision import NOTHING_ACTIVE, Decision, Late, Strategy
from rampart.manager.strategies.guarded_repair import GuardedRepair
from rampart.manager.strategies.mission_first import MissionFirst
from rampart.manager.strategies.safety_first import SafetyFirst
from rampart.manager.strategies.simultaneous import Simultaneous

STRATEGIES: dict[str, Strategy] = {strategy.name: strategy for strategy in (
    SafetyFirst(), MissionFirst(), Simultaneous(), GuardedRepair())}

CACHED = 4096
"""Decisions in the cache; seven mechanisms have 128 active sets."""


class UnknownStrategyError(ValueError):
    """No strategy has this name."""


def find_strategy(name: str) -> Strategy:
    """Return the strategy of that name.

    Raises:
        UnknownStrategyError: The name is unknown; the message lists the known ones.
    """
    if name not in STRATEGIES:
        raise UnknownStrategyError(
            f"unknown strategy {name!r}; known: {', '.join(sorted(STRATEGIES))}")
    return STRATEGIES[name]


class Decider:
    """A strategy applied to an arrangement, with a cache of its decisions."""

    def __init__(self, strategy: Strategy, arrangement: Arrangement) -> None:
        self.strategy = strategy
        self.arrangement = arrangement
        self._choose = lru_cache(CACHED)(
            lambda active, late: strategy.choose(active, arrangement, late))

    def choose(self, active: tuple[str, ...], late: Late = frozenset()) -> Decision:
        """Decide without a certificate; `active` is in declared sequence."""
        if not active:
            return NOTHING_ACTIVE
        return self._choose(active, late if self.strategy.patient else frozenset())

    def explain(self, decision: Decision) -> Decision:
        """Return a decision of `choose` with its certificate."""
        if not decision.active:
            return decision
        return self.strategy.explain(decision, self.arrangement)


def decide(active: Iterable[str], mechanisms: Mechanisms, tree: Tree,
           order: PartialOrder, strategy: str = "safety-first") -> Decision:
    """Decide by the strategy of that name, with the certificate.

    Raises:
        UnknownElementError: A name in `active` is not a mechanism.
        UnknownStrategyError: The strategy is unknown.
    """
    decider = _decider(strategy, mechanisms, tree, order)
    return decider.explain(decider.choose(mechanisms.sort(active)))


@lru_cache(maxsize=16)
def _decider(strategy: str, mechanisms: Mechanisms, tree: Tree, order: PartialOrder) -> Decider:
    return Decider(find_strategy(strategy), Arrangement(mechanisms, tree, order))


def named(name: str, titles: Mapping[str, str]) -> str:
    """Return a name with its title: "title (name)"."""
    title = titles.get(name, "")
    return f"{title} ({name})" if title and title != name else name


def decision_in_words(active: Sequence[str], rule: int, recoveries: Sequence[str],
                      strategy: str = "safety-first",
                      titles: Mapping[str, str] = MappingProxyType({})) -> str:
    """Return a decision as one sentence, with `SystemSpec.titles` if given.

    If the strategy is unknown, as in an old recording, the rule is shown as a number only.
    """
    active, recoveries = ([named(name, titles) for name in names] for names in (active, recoveries))
    if not active and recoveries:
        return (f"No mechanism is active any more; {listing(recoveries)} "
                f"{'stays' if len(recoveries) == 1 else 'stay'} in force until reset.")
    if not active:
        return "No mechanism is active: there is nothing to recover from."
    taken = listing(recoveries) if recoveries else "No recovery"
    known = STRATEGIES.get(strategy)
    reason = known.rules.get(rule) if known else None
    because = f", because {reason}" if reason else ""
    block = f"block {rule}" if strategy == "safety-first" else f"{strategy}, rule {rule}"
    return f"{taken}: {listing(active)}{because} ({block})."


def listing(names: Sequence[str]) -> str:
    """Return names as "A", "A and B" or "A, B and C"; "nothing" if there are none."""
    return " and ".join(filter(None, (", ".join(names[:-1]), *names[-1:]))) or "nothing"
