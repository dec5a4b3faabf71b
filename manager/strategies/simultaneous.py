"""Simultaneous recoveries, which the paper suggests as future work."""

from __future__ import annotations

import msgspec

from rampart.manager.strategies.arrangement import Arrangement
from rampart.manager.strategies.decision import Decision, Late, dominance, turned_down


class Simultaneous:
    """All maximal recoveries at once, as far as they can run together.

    1. Only one mechanism is active: its recovery.
    2. Else all recoveries of the active mechanisms that no other dominates, if no two claim the
       same resource and none disables what another needs.
    3. Else the mechanisms whose recoveries are in conflict are replaced by their lowest common
       dominant in the FTMTree, and rule 2 applies again.
    """

    name = "simultaneous"
    patient = False
    exclusive = False
    rules = {
        1: "it is the only active mechanism",
        2: "these are the recoveries that no other dominates, and they can run together",
        3: "recoveries in conflict give way to that of their lowest common dominant",
    }

    def choose(self, active: tuple[str, ...], arrangement: Arrangement, late: Late  # noqa: ARG002
               ) -> Decision:
        """Decide by the three rules."""
        tree, order = arrangement.tree, arrangement.order
        recover = arrangement.mechanisms.recover
        sakes, rule = active, 1 if len(active) == 1 else 2
        while True:
            if len(sakes) == 1:  # all its parts, even if one dominates another
                return Decision(active, rule, recover[sakes[0]], sakes)
            maximal = order.maximal(arrangement.demanded(sakes))
            clash = [name for name in maximal if not arrangement.can_join(name, maximal)]
            if not clash:
                return Decision(active, rule, maximal, arrangement.asking(sakes, maximal))
            rule = 3
            upper = tree.lowest_common_dominant(arrangement.asking(sakes, clash))
            sakes = arrangement.mechanisms.sort(
                (upper, *(n for n in sakes if n != upper and not tree.is_above(upper, n))))

    def explain(self, decision: Decision, arrangement: Arrangement) -> Decision:
        """Add the chains of dominance, and why other recoveries were rejected."""
        tree, order = arrangement.tree, arrangement.order
        taken = decision.recoveries
        candidates = arrangement.demanded(decision.active)
        climbed = (upper for upper in decision.mechanisms if upper not in decision.active)
        path = dominance(order, taken, candidates) + dominance(tree, climbed, decision.active)
        return msgspec.structs.replace(decision, path=path or taken,
                                       rejected=turned_down(order, taken, candidates))
