"""Guarded repair: as safe as every active mechanism asks for, and never stuck.

Rampart's own strategy. `rampart verify` found two costs of the paper's safety-first:

* It runs one recovery. If a control node dies and its command goes stale, FTM2 dominates FTM4. RM2
  stops the robot, RM3 never starts, and the robot stands permanently.
* Where neither tree nor order decides (block 4) it climbs the tree, often to the emergency stop,
  although a milder recovery would suffice. FTM4 and FTM7, two crashes at once, end in RM1. And it
  is not monotone: with FTM6 active *as well* it runs RM5.

Guarded repair separates two tasks. One recovery, the *guard*, brings the robot to a state that is
safe enough: the mildest recovery at least as safe as each one asked for. Beneath it all repairs
asked for run at once, so that the causes disappear and the guard can be released.
"""

from __future__ import annotations

from itertools import chain

import msgspec

from rampart.manager.strategies.arrangement import Arrangement
from rampart.manager.strategies.decision import Decision, Late, dominance, turned_down


class GuardedRepair:
    """A guard that is at least as safe as every recovery asked for, and repairs beneath it.

    1. Only one mechanism is active: its recovery.
    2. Else the guard is the recovery asked for that dominates all others asked for.
    3. Else it is a least recovery that dominates all those asked for; of several, that of the
       lowest common dominant, or else the first declared.
    4. Else the guards are the recoveries of the lowest common dominant, as in safety-first.

    Every repair asked for runs beneath the guard. One that conflicts with a running recovery waits
    until that is done.
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
        """Return rule, guards, and the mechanism they act for if it may not ask for them."""
        order, recover = arrangement.order, arrangement.mechanisms.recover
        guard = order.greatest(demanded)
        if guard is not None:
            return 2, (guard,), ()
        dominant = arrangement.tree.lowest_common_dominant(active)
        above = [name for name in order.names
                 if all(name == asked or order.is_above(name, asked) for asked in demanded)]
        least = {name for name in above if not any(order.is_above(name, o) for o in above)}
        if not least:
            return 4, recover[dominant], (dominant,)
        preferred = chain(recover[dominant], arrangement.mechanisms.recoveries)
        return 3, (next(name for name in preferred if name in least),), (dominant,)

    def explain(self, decision: Decision, arrangement: Arrangement) -> Decision:
        """Add what the guard dominates, and why other recoveries were rejected."""
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
