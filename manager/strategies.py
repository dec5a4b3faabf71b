"""Strategies: from the active mechanisms to the recovery to run.

A strategy is a pure function, registered by name; a system spec names the one it wants. It can be
replaced without touching any detection or recovery module, which know nothing of each other.

`safety-first` is the paper's (section IV-A, figure 7), block by block.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

from manager.decision import NOTHING_ACTIVE, Decision, Strategy, chains, undominated
from manager.mechanisms import Mechanisms
from manager.order import PartialOrder, Tree

STRATEGIES: dict[str, Strategy] = {}


class UnknownStrategyError(ValueError):
    """No strategy has this name."""


def register(name: str) -> Callable[[Strategy], Strategy]:
    """Make a strategy known under a name.

    Raises:
        ValueError: The name is taken.
    """
    def add(strategy: Strategy) -> Strategy:
        if name in STRATEGIES:
            raise ValueError(f"strategy {name!r} is registered twice")
        STRATEGIES[name] = strategy
        return strategy
    return add


def find_strategy(name: str) -> Strategy:
    """Return the strategy of that name.

    Raises:
        UnknownStrategyError: There is none; the message lists those there are.
    """
    try:
        return STRATEGIES[name]
    except KeyError:
        raise UnknownStrategyError(
            f"unknown strategy {name!r}; known: {', '.join(sorted(STRATEGIES))}") from None


def decide(active: Iterable[str], mechanisms: Mechanisms, tree: Tree, order: PartialOrder,
           strategy: str = "safety-first") -> Decision:
    """Decide by the strategy of that name.

    Raises:
        UnknownElementError: `active` names something that is no mechanism.
        UnknownStrategyError: No such strategy.
    """
    return find_strategy(strategy)(active, mechanisms, tree, order)


def choose_safety_first(active: Iterable[str], mechanisms: Mechanisms, tree: Tree,
                        order: PartialOrder) -> tuple[int, int, int]:
    """Take the safety-first decision alone, without its certificate.

    Returns:
        The block (0 if nothing is active); the number in `tree` of the mechanism that blocks 1, 2
        and 4 take, else -1; the number in `order` of the recovery to run, or -1 if none.
    """
    recover = mechanisms.recover
    ftms = rms = 0
    for name in active:
        ftms |= tree.bit[name]
        rms |= order.bit[recover[name]]
    if not ftms:
        return 0, -1, -1
    ftm = tree.greatest_in(ftms)
    if ftm >= 0:
        return (2 if ftms & (ftms - 1) else 1), ftm, order.number[recover[tree.names[ftm]]]
    # Block 3 asks for a recovery that dominates all *others*, and mechanisms may share one: FTM5
    # and FTM7 active is {RM4}, a set with no others, which RM4 therefore dominates. Counting
    # recoveries per mechanism instead (RM4 against RM4) would find no strict dominance and fall
    # through to block 4: an emergency stop for two crashes that one respawn cures.
    rm = order.greatest_in(rms)
    if rm >= 0:
        return 3, -1, rm
    ftm = tree.lowest_common_in(ftms)
    return 4, ftm, order.number[recover[tree.names[ftm]]]


@register("safety-first")
def safety_first(active: Iterable[str], mechanisms: Mechanisms, tree: Tree,
                 order: PartialOrder) -> Decision:
    """Apply the paper's safety-first strategy.

    1. Only one mechanism is active: its recovery.
    2. Else one active mechanism dominates all the others in the FTMTree: its recovery.
    3. Else one of the active mechanisms' recoveries dominates all the others in the RM order:
       that recovery.
    4. Else the recovery of the lowest common dominant of the active mechanisms in the FTMTree,
       which need not be active itself.
    """
    names = mechanisms.sort(active)
    block, ftm, rm = choose_safety_first(names, mechanisms, tree, order)
    if block == 0:
        return NOTHING_ACTIVE
    recovery = order.names[rm]
    if block == 1:
        return Decision(names, 1, (recovery,), names, names)
    recover = mechanisms.recover
    others = [name for name in names if recover[name] != recovery]
    if block == 2:
        chosen = tree.names[ftm]
        return Decision(
            names, 2, (recovery,), (chosen,), chains(tree, chosen, names),
            tuple((recover[name], f"{name} is dominated by {chosen}") for name in others))
    candidates = tuple(dict.fromkeys(recover[name] for name in names))
    no_block_2 = undominated(tree, names)
    if block == 3:
        return Decision(
            names, 3, (recovery,),
            tuple(name for name in names if recover[name] == recovery),
            chains(order, recovery, candidates) or (recovery,),
            no_block_2 + tuple((name, f"{recovery} is safer") for name in candidates
                               if name != recovery))
    chosen = tree.names[ftm]
    return Decision(names, 4, (recovery,), (chosen,), chains(tree, chosen, names),
                    no_block_2 + tuple(pair for pair in undominated(order, candidates)
                                       if pair[0] != recovery))
