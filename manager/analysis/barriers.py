"""Finds the mechanisms that stand between causes and the top event.

A mechanism on event *e* is a *barrier on a cut set* if preventing *e* keeps the events of that set
from making the top occur. So it shows on which paths to the top a second barrier is missing.
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
    """What is left before the top event in a situation.

    Attributes:
        occurred: Events of the active mechanisms.
        left: For each active mechanism, the idle barriers above it.
        next_events: Basic events that each alone would now make the top occur, with the idle
            barriers that are then left; events with the fewest barriers first.
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
    """Return some events with the mechanisms that can prevent the top."""
    return Guarded(tuple(events), tuple(
        name for name in mechanisms if tree.top not in tree.occurring(occurred, event_of[name])))


def outlook(spec: SystemSpec, active: Iterable[str]) -> Outlook:
    """Return what is left before the top event if the events of active mechanisms have occurred."""
    tree = spec.build_fault_tree()
    ftms = spec.build_ftm_tree()
    event_of = {m.name: m.event for m in spec.mechanisms}
    named = set(active)
    breached = [name for name in ftms.names if name in named]
    idle = [name for name in ftms.names if name not in named]
    occurred = tuple(event_of[name] for name in breached)
    left = {name: tuple(upper for upper in ftms.chain(ftms.root, name) if upper in idle)
            for name in breached}
    # If these events suffice already, each next event is considered alone.
    base = () if tree.top in tree.occurring(occurred) else occurred
    following = [
        _guarded(tree, (name,), (*base, name), idle, event_of)
        for name, event in tree.events.items() if not event.required and name not in occurred
        and tree.top in tree.occurring((*base, name))]
    return Outlook(occurred, left, tuple(sorted(following, key=lambda g: len(g.barriers))))
