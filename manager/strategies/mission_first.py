"""Mission first: the deepest barrier first, as long as there is time.

The deepest mechanism interferes least with the mission: a respawn rather than a stop. The next
barrier up the FTMTree takes over only if the detection persists longer than the mechanism's
*patience*, the time that its budget leaves (`rampart.manager.spec.budget`).

This is less safe than safety-first: if a consequence is detected as well, its recovery waits for
that of the cause.
"""

from __future__ import annotations

import msgspec

from rampart.manager.strategies.arrangement import Arrangement
from rampart.manager.strategies.decision import Decision, Late


class MissionFirst:
    """The deepest barriers first, one step up the FTMTree for each that is late.

    Each active mechanism with no active one in time below it asks for its recovery. A late one asks
    for that of its parent, and so on up. All recoveries asked for run together. Of two in conflict
    the upper one in the order runs, else that of the deeper mechanism, else the first declared.

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
                continue  # its cause is being recovered
            while name in late and tree.parents[name]:
                name = str(tree.parents[name])  # noqa: PLW2901 climbing
            asking[name] = None
        # Of barriers in time none is above another.
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
        """Add which barriers were taken, and why the others wait."""
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
