"""Which mechanisms are late: their recovery has not ended the error within its patience."""

from __future__ import annotations

from msgspec.structs import replace

from rampart.manager.arbitration.arbiter_state import State
from rampart.manager.strategies.arrangement import Arrangement


def with_late(state: State, active: tuple[str, ...], arrangement: Arrangement, now: float) -> State:
    """Note since when mechanisms have had their turn, and which of them are late.

    One that has to wait for a deeper one does not lose its patience meanwhile, or it would be
    late, and the next above in force, the moment the deeper one has succeeded. One whose recovery
    is in force is not late; but a repair ends the error or it does not.
    """
    tree, mechanisms = arrangement.tree, arrangement.mechanisms
    before = dict(state.since)
    in_time = [name for name in active if name not in state.late]
    since = tuple((name, now if any(tree.is_above(name, deeper) for deeper in in_time)
                   else before.get(name, now)) for name in active)
    in_force = {track.name for track in state.recoveries
                if track.in_force and not mechanisms.contracts[track.name].kind.repairs}
    return replace(state, since=since, late=frozenset(
        name for name, since_s in since
        if name in state.late or (now - since_s > mechanisms.by_name[name].patience_s
                                  and not in_force.issuperset(mechanisms.recover[name]))))
