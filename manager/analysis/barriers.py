"""Finds the mechanisms that stand between causes and the top event.

A mechanism on event *e* is a *barrier on a cut set* if preventing *e* keeps the events of that set
from making the top occur. So it shows on which paths to the top a second barrier is missing.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import msgspec

from rampart.manager.spec.schema import SystemSpec


class Guarded(msgspec.Struct, frozen=True):
    """A cut set and the barriers on it, the nearest to the top first."""

    events: tuple[str, ...]
    barriers: tuple[str, ...]


def guard(spec: SystemSpec, sets: Iterable[Sequence[str]]) -> tuple[Guarded, ...]:
    """Return cut sets with the mechanisms that are barriers on each."""
    tree = spec.build_fault_tree()
    order = spec.build_ftm_tree().names if spec.mechanisms else ()
    event_of = {m.name: m.event for m in spec.mechanisms}
    return tuple(Guarded(tuple(events), tuple(
        name for name in order if tree.top not in tree.occurring(events, event_of[name])))
        for events in sets)
