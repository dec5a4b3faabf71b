"""Repair under guard: as safe as every active mechanism asks for, and no stop without end.

Our own strategy. The paper's safety-first has two costs, both found by `rampart verify`:

* It runs one recovery. With a dead control node and its consequence, a stale command, FTM2
  dominates FTM4, RM2 stops the robot, RM3 is never started, and the robot stands there permanently.
* Where neither tree nor order decides (block 4) it climbs the tree, often to the emergency stop,
  although a less drastic recovery would be safer than all that are asked for. Two node crashes at
  once, FTM4 and FTM7, end in RM1. And it is not monotone: with FTM6 active *as well*, it is RM5.

Repair under guard separates the two things that recoveries do. One recovery, the *guard*, takes
the robot to a state that is safe enough for all of them: the mildest one that is at least as
safe as each recovery asked for. Beneath it all repairs that are asked for run at once, so that the
causes go away and the guard can be released.
"""

from __future__ import annotations

from itertools import chain

import msgspec

from rampart.manager.strategies.arrangement import Arrangement
from rampart.manager.strategies.decision import Decision, Late, dominance, turned_down


class GuardedRepair:
    """A guard that is at least as safe as every recovery asked for, and repairs beneath it.

    1. Only one mechanism is active: its recovery.
    2. Else the guard is the recovery asked for that dominates all the others asked for.
    3. Else it is the least of all recoveries that dominate those asked for: one that has no other
       such below it; of several that of the lowest common dominant, or else the first declared.
    4. There is none: the recoveries of the lowest common dominant, as in safety-first.

    Every repair that is asked for runs beneath the guard, unless it claims what another one
    claims; then it waits until that one is done.
    """

    name = "guarded-repair"
    patient = False
    exclusive = False
    rules = {
        1: "it is the only active mechanism",
        2: "one recovery asked for is safer than all the others, and repairs run beneath it",
        3: "it is the mildest recovery that is safer than all those asked for, and repairs run "
           "beneath it",
        4: "no recovery is safer than all, so the lowest common dominant decides, and repairs run "
           "beneath it",
    }

    def choose(self, active: tuple[str, ...], arrangement: Arrangement, late: Late  # noqa: ARG002
               ) -> Decision:
        """Decide by the four rules."""
        mechanisms = arrangement.mechanisms
        if len(active) == 1:
            return Decision(active, 1, mechanisms.recover[active[0]], active)
        demanded = arrangement.demanded(active)
        rule, guards, sakes = self._guard(active, demanded, arrangement)
        repairs = (name for name in demanded if mechanisms.contracts[name].kind.repairs)
        taken = arrangement.compatible(repairs, beside=guards)
        return Decision(active, rule, taken,
                        mechanisms.sort((*sakes, *arrangement.asking(active, taken))))

    def _guard(self, active: tuple[str, ...], demanded: tuple[str, ...], arrangement: Arrangement
               ) -> tuple[int, tuple[str, ...], tuple[str, ...]]:
        """Return rule, guard, and the mechanism for whose sake it is, if it need not ask for it."""
        order, recover = arrangement.order, arrangement.mechanisms.recover
        guard = order.greatest(demanded)
        if guard is not None:
            return 2, (guard,), ()  # for the sake of those that ask for it, and they are active
        dominant = arrangement.tree.lowest_common_dominant(active)
        above = [name for name in order.names
                 if all(name == one or order.is_above(name, one) for one in demanded)]
        least = {name for name in above if not any(order.is_above(name, one) for one in above)}
        if not least:
            return 4, recover[dominant], (dominant,)
        preferred = chain(recover[dominant], arrangement.mechanisms.recoveries)
        return 3, (next(name for name in preferred if name in least),), (dominant,)

    def explain(self, decision: Decision, arrangement: Arrangement) -> Decision:
        """Give what the guard dominates, and why the others were rejected."""
        if decision.rule == 1:
            return msgspec.structs.replace(decision, path=decision.active)
        order, taken = arrangement.order, decision.recoveries
        candidates = arrangement.demanded(decision.active)
        contracts = arrangement.mechanisms.contracts
        waiting = {name for name in candidates if contracts[name].kind.repairs
                   and not arrangement.can_join(name, taken)}
        rejected = (
            (name, "waits, another recovery claims the same" if name in waiting else why)
            for name, why in turned_down(order, taken, candidates))
        return msgspec.structs.replace(
            decision, path=dominance(order, taken, candidates) or taken, rejected=tuple(rejected))
