"""The paper's strategy (section IV-A, figure 7), block by block."""

from __future__ import annotations

from msgspec.structs import replace

from rampart.manager.strategies.arrangement import Arrangement
from rampart.manager.strategies.decision import (
    Decision,
    Late,
    chains,
    dominance,
    turned_down,
    undominated,
)


class SafetyFirst:
    """The paper's four blocks.

    1. Only one mechanism is active: its recovery.
    2. Else one active mechanism dominates all others in the FTMTree: its recovery.
    3. Else one of the active mechanisms' recoveries dominates all others in the RM order: that
       recovery.
    4. Else the recovery of the lowest common dominant of the active mechanisms in the FTMTree,
       which need not be active itself.
    """

    name = "safety-first"
    patient = False
    exclusive = True
    rules = {
        1: "it is the only active mechanism",
        2: "one active mechanism dominates all the others in the FTM tree",
        3: "one of the recoveries in question is safer than all the others",
        4: "no mechanism and no recovery dominates, so the lowest common dominant decides",
    }

    def choose(self, active: tuple[str, ...], arrangement: Arrangement, late: Late  # noqa: ARG002
               ) -> Decision:
        """Decide by the four blocks."""
        tree, recover = arrangement.tree, arrangement.mechanisms.recover
        dominant = tree.greatest(active)
        if dominant is not None:
            return Decision(active, 1 if len(active) == 1 else 2, recover[dominant], (dominant,))
        # Mechanisms may share a recovery. For FTM5 and FTM7 the set is {RM4}, and RM4 dominates
        # all others, since there are none. Compared per mechanism, RM4 would not dominate RM4,
        # and block 4 would answer two crashes that one respawn repairs with an emergency stop.
        taken = _dominating(active, arrangement)
        if taken:
            return Decision(active, 3, taken,
                            tuple(name for name in active if set(recover[name]) & set(taken)))
        chosen = tree.lowest_common_dominant(active)
        return Decision(active, 4, recover[chosen], (chosen,))

    def explain(self, decision: Decision, arrangement: Arrangement) -> Decision:
        """Add the path of dominance, and why other recoveries were rejected."""
        tree, order = arrangement.tree, arrangement.order
        recover = arrangement.mechanisms.recover
        names, taken, chosen = decision.active, decision.recoveries, decision.mechanisms[0]
        if decision.rule == 1:
            return replace(decision, path=names)
        if decision.rule == 2:
            return replace(decision, path=chains(tree, chosen, names), rejected=tuple(
                (recovery, f"{name} is dominated by {chosen}")
                for name in names for recovery in recover[name] if recovery not in taken))
        no_block_2, candidates = undominated(tree, names), arrangement.demanded(names)
        if decision.rule == 3:
            return replace(decision, path=dominance(order, taken, candidates) or taken,
                           rejected=no_block_2 + turned_down(order, taken, candidates))
        no_block_3 = tuple(
            pair for pair in undominated(order, candidates) if pair[0] not in taken)
        return replace(
            decision, path=chains(tree, chosen, names), rejected=no_block_2 + no_block_3)


def _dominating(active: tuple[str, ...], arrangement: Arrangement) -> tuple[str, ...]:
    """Return the recoveries of one active mechanism that dominate those of all others, or ()."""
    order, demanded = arrangement.order, arrangement.demanded(active)
    greatest = order.greatest(demanded)
    if greatest is not None:
        return (greatest,)
    for name in active if arrangement.compound else ():
        way = arrangement.mechanisms.recover[name]
        if all(other in way or any(order.is_above(upper, other) for upper in way)
               for other in demanded):
            return way
    return ()
