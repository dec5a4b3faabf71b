"""Mission first: the deepest barrier first, as long as there is time.

A fault low in the fault tree is met by the mechanism that stands there, which interferes least
with the mission: a respawn rather than a stop. Only when the detection persists after that
mechanism's *patience*, the time that may pass before the consequence is out of hand
(`rampart.manager.spec.budget`), does the next barrier up the FTMTree take over.

It is not as safe as safety-first and does not claim to be: where a consequence is detected as
well, its own recovery waits until the cause's had its chance.
"""

from __future__ import annotations

import msgspec

from rampart.manager.strategies.arrangement import Arrangement
from rampart.manager.strategies.decision import Decision, Late


class MissionFirst:
    """The deepest barriers first, one step up the FTMTree for each that is late.

    Each active mechanism that no active one in time is below asks for its recovery; one that is
    late asks for that of its parent, and so on up. All that are asked for run together; of two in
    conflict the one above in the order, else the one of the deeper mechanism, else the one
    declared first.

    1. No active mechanism is late.
    2. At least one is late, so a barrier further up was taken.
    3. The mechanism at the root is active, no time is left for a deeper one: its recovery.
    """

    name = "mission-first"
    patient = True
    exclusive = False
    rules = {
        1: "the deepest barrier comes first while it is in time",
        2: "a deeper barrier did not end the error in time, so the next one above takes over",
        3: "the last barrier is reached, and there is no time left for a deeper one",
    }

    def choose(self, active: tuple[str, ...], arrangement: Arrangement, late: Late) -> Decision:
        """Decide by the three rules."""
        tree, order, mechanisms = arrangement.tree, arrangement.order, arrangement.mechanisms
        if tree.root in active:
            return Decision(active, 3, mechanisms.recover[tree.root], (tree.root,))
        climbed = not late.isdisjoint(active)
        in_time = tree.mask(name for name in active if name not in late)
        asking: dict[str, None] = {}
        for name in active:
            if tree.below[tree.number[name]] & in_time:
                continue  # the cause is being dealt with
            while name in late and tree.parents[name]:
                name = str(tree.parents[name])  # noqa: PLW2901 climbing
            asking[name] = None
        # Of barriers in time none is above another already.
        highest = tree.maximal(asking) if climbed else asking
        deepest_first = sorted(
            highest, key=lambda name: tree.up_set[tree.number[name]].bit_count(), reverse=True)
        demanded = arrangement.demanded(deepest_first)
        mask = order.mask(demanded)
        taken = arrangement.compatible(sorted(
            demanded, key=lambda name: (order.up_set[order.number[name]] & mask).bit_count()))
        sakes = mechanisms.sort(arrangement.asking(highest, taken))
        return Decision(active, 2 if climbed else 1, taken, sakes)

    def explain(self, decision: Decision, arrangement: Arrangement) -> Decision:
        """Say which barriers were taken, and why the others wait."""
        tree, recover = arrangement.tree, arrangement.mechanisms.recover
        path, rejected = [], []
        for name in decision.active:
            upper = next((m for m in decision.mechanisms
                          if m == name or tree.is_above(m, name)), None)
            if upper is not None:
                path.append(" > ".join(tree.chain(upper, name)))
            for recovery in recover[name]:
                if recovery in decision.recoveries:
                    continue
                deeper = next((m for m in decision.mechanisms if tree.is_above(name, m)), None)
                rejected.append((recovery, (
                    f"{deeper} is deeper and comes first" if deeper else
                    f"{name} is late, {upper} is above it" if upper else
                    "conflicts with another recovery")))
        return msgspec.structs.replace(decision, path=tuple(path), rejected=tuple(rejected))
