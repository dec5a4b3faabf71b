"""Recoveries that stay in force although nothing asks for them: latched ones, and adopted ones.

A latched recovery stays until an operator resets it, and a reset is refused while its cause
persists. An adopted one was found activated by an arbiter that had just started, and stays until
all modules have been heard. Only a safer recovery takes the place of either.
"""

from __future__ import annotations

from collections.abc import Sequence

from msgspec.structs import replace

from rampart.manager.arbitration.arbiter_state import State
from rampart.manager.arbitration.recovery_track import RecoveryTrack
from rampart.manager.strategies.arrangement import Arrangement
from rampart.manager.strategies.decision import Decision


def refusal(state: State, recovery: str, decision: Decision) -> str:
    """Say why a recovery is not reset; "" if it may be.

    Args:
        state: Of the arbiter.
        recovery: Name, as it was typed.
        decision: What would run if nothing were latched.
    """
    if recovery not in state.latched:
        known = recovery in state.desired
        return "it is not latched" if known else "there is no such recovery module"
    if not state.oriented:
        return "not all modules have been heard yet"
    if recovery in decision.recoveries:
        return f"the cause persists: {', '.join(decision.active)} active"
    return ""


def keep(decision: Decision, kept: Sequence[RecoveryTrack], arrangement: Arrangement, *,
         exclusive: bool) -> Decision:
    """Return a decision in which the safest of the kept recoveries stays, or a safer one runs.

    Args:
        decision: Without regard to what is kept.
        kept: Latched and adopted recoveries, at least one. Several are only if one drains under
            another.
        arrangement: Of the system.
        exclusive: No repairs run beneath.
    """
    order, contracts = arrangement.order, arrangement.mechanisms.contracts
    safest = min(kept, key=lambda track: order.number[track.name])
    base = tuple(name for name in decision.recoveries
                 if name == safest.name or order.is_above(name, safest.name)) or (safest.name,)
    others = [name for name in decision.recoveries if name not in base]
    beneath = () if exclusive else tuple(
        name for name in others if contracts[name].kind.repairs
        and arrangement.can_join(name, order.mask(base)))
    why = "is latched until reset" if safest.latched else \
        "was found activated, and not all modules have been heard yet"
    return replace(decision, recoveries=base + beneath, rejected=decision.rejected + tuple(
        (name, f"{safest.name} {why}") for name in others if name not in beneath))
