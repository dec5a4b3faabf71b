"""Which mechanisms stand between causes and the top event.

A mechanism on event *e* is a *barrier on a cut set* if the top does not occur from exactly the
events of that set once *e* is kept from occurring. Where two barriers are wanted on every way to
the top, this shows where one is missing.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import msgspec

from rampart.manager.model.fault_tree import FaultTree
from rampart.manager.spec.schema import SystemSpec


class Guarded(msgspec.Struct, frozen=True):
    """A cut set and the barriers on it, the nearest to the top first."""

    events: tuple[str, ...]
    barriers: tuple[str, ...]


class Outlook(msgspec.Struct, frozen=True):
    """What is left before the top event, given what has occurred.

    Attributes:
        occurred: Events that have occurred by what is detected.
        left: For each active mechanism the barriers above it that are still idle.
        next_events: Basic events, each of which by itself, with what has occurred, would make the
            top occur; with the idle barriers that are then left, those with the fewest first.
    """

    occurred: tuple[str, ...]
    left: dict[str, tuple[str, ...]]
    next_events: tuple[Guarded, ...]


def guard(spec: SystemSpec, sets: Iterable[Sequence[str]]) -> tuple[Guarded, ...]:
    """Return cut sets with the mechanisms that are barriers on each."""
    tree = spec.build_fault_tree()
    order = spec.build_ftm_tree().names if spec.mechanisms else ()
    event_of = {m.name: m.event for m in spec.mechanisms}
    return tuple(_guarded(tree, events, events, order, event_of) for events in sets)


def _guarded(tree: FaultTree, events: Sequence[str], occurred: Sequence[str],
             mechanisms: Iterable[str], event_of: Mapping[str, str]) -> Guarded:
    """Return some events with the mechanisms that keep the top from occurring."""
    return Guarded(tuple(events), tuple(
        name for name in mechanisms if tree.top not in tree.occurring(occurred, event_of[name])))


def outlook(spec: SystemSpec, active: Iterable[str]) -> Outlook:
    """Return what is left before the top event.

    Args:
        spec: The system.
        active: Active mechanisms: the event of each has occurred, for its detection says so.
    """
    tree = spec.build_fault_tree()
    ftms = spec.build_ftm_tree()
    event_of = {m.name: m.event for m in spec.mechanisms}
    wanted = set(active)
    breached = [name for name in ftms.names if name in wanted]
    idle = [name for name in ftms.names if name not in wanted]
    occurred = tuple(event_of[name] for name in breached)
    left = {name: tuple(upper for upper in ftms.chain(ftms.root, name) if upper in idle)
            for name in breached}
    # If what has occurred suffices already, the next event is looked at by itself.
    base = () if tree.top in tree.occurring(occurred) else occurred
    following = [
        _guarded(tree, (name,), (*base, name), idle, event_of)
        for name, event in tree.events.items() if not event.required and name not in occurred
        and tree.top in tree.occurring((*base, name))]
    return Outlook(occurred, left, tuple(sorted(following, key=lambda g: len(g.barriers))))
