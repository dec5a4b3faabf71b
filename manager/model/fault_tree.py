"""The fault tree, and the FTMTree that is derived from the places of mechanisms in it.

A fault tree defines how unwanted events combine into the top event (IEC 61025). Each FTM is a
barrier on one event, and keeps it from propagating. The FTMTree is derived (paper, figures 6 and
8a): *the parent of an FTM is the nearest FTM above it*.

An event may feed several gates as a common cause. But every mechanism needs exactly one parent,
since block 4 asks for the lowest common dominant. So a mechanism whose paths to the top meet
different mechanisms first is refused.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from graphlib import TopologicalSorter

import msgspec

from rampart.manager.model.order import Tree, find_cycle


class FaultTreeError(ValueError):
    """Events or mechanisms do not form a tree; `subject` names the event or mechanism."""

    def __init__(self, subject: str, problem: str) -> None:
        self.subject = subject
        super().__init__(problem)


class Event(msgspec.Struct, frozen=True):
    """An unwanted event.

    It occurs if at least `required` of its inputs do: 1 is OR, all is AND. A basic event has no
    inputs, and `required` is 0.
    """

    name: str
    inputs: tuple[str, ...] = ()
    required: int = 0


class FaultTree:
    """Events joined by gates, with exactly one top.

    Args:
        events: All events, in any sequence; names are unique.

    Raises:
        FaultTreeError: A gate without inputs or that needs more inputs than it has, a cycle, or
            not exactly one top event.
    """

    def __init__(self, events: Sequence[Event]) -> None:
        self.events = {event.name: event for event in events}
        self.parents: dict[str, list[str]] = {name: [] for name in self.events}
        for event in events:
            self._join(event)
        inputs = {event.name: event.inputs for event in events}
        cycle = find_cycle(inputs)
        if cycle:
            raise FaultTreeError(cycle[0], f"cycle {' > '.join(cycle)}; "
                                           "an event cannot be its own cause")
        tops = [name for name, parents in self.parents.items() if not parents]
        if not tops:
            raise FaultTreeError("", "no events; expected exactly one top event")
        if len(tops) > 1:
            raise FaultTreeError(tops[1], f"unreachable from the top event {tops[0]!r}; expected "
                                          "exactly one event that is not an input of a gate")
        self.top = tops[0]
        self._upwards = tuple(TopologicalSorter(inputs).static_order())

    def _join(self, event: Event) -> None:
        if event.required and not event.inputs:
            raise FaultTreeError(event.name, "gate without inputs; expected causes in 'of'")
        if not 0 <= event.required <= len(event.inputs) or bool(event.inputs) > event.required:
            raise FaultTreeError(event.name, f"gate needs {event.required} of "
                                             f"{len(event.inputs)} inputs")
        for name in event.inputs:
            if event.name in self.parents[name][-1:]:
                raise FaultTreeError(event.name, f"input {name!r} is listed twice")
            self.parents[name].append(event.name)

    def occurring(self, given: Iterable[str], prevented: str = "") -> set[str]:
        """Return all events that occur if the given ones occur and one is prevented."""
        occurring = set(given) - {prevented}
        for name in self._upwards:
            event = self.events[name]
            if name != prevented and event.required \
                    and sum(entry in occurring for entry in event.inputs) >= event.required:
                occurring.add(name)
        return occurring

    def derive_ftm_tree(self, placement: Mapping[str, str]) -> Tree:
        """Derive the FTMTree.

        Args:
            placement: Mechanism name → name of its event.

        Raises:
            FaultTreeError: Two mechanisms on one event, several parents, or not exactly one root.
        """
        at: dict[str, str] = {}
        for mechanism, event in placement.items():
            if event in at:
                raise FaultTreeError(mechanism, f"event {event!r} already has {at[event]}; add an "
                                     "event between them to define which is nearer to the top")
            at[event] = mechanism
        nearest = self._nearest_mechanisms(at)
        parents: dict[str, str | None] = {}
        for mechanism, event in placement.items():
            above = nearest[event]
            if len(above) > 1:
                found = ", ".join(sorted(name or "none" for name in above))
                raise FaultTreeError(mechanism, f"several parents in the FTMTree: {found}; event "
                                     f"{event!r} has a path to the top past each of them")
            parents[mechanism] = next(iter(above)) or None
        roots = [mechanism for mechanism, parent in parents.items() if parent is None]
        if len(roots) != 1:
            raise FaultTreeError(roots[1] if roots else "", (
                f"the FTMTree has {len(roots)} roots: {', '.join(roots) or 'none'}; expected "
                "exactly one mechanism with none above it, e.g. one on the top event"))
        return Tree(parents)

    def _nearest_mechanisms(self, at: Mapping[str, str]) -> dict[str, frozenset[str]]:
        """Return for each event the first mechanism on each of its paths to the top.

        A path without a mechanism adds the empty name, since a mechanism that can be bypassed is
        not a parent.
        """
        nearest = {self.top: frozenset({""})}
        for event in TopologicalSorter(self.parents).static_order():
            if event != self.top:
                nearest[event] = frozenset().union(*(
                    {at[parent]} if parent in at else nearest[parent]
                    for parent in self.parents[event]))
        return nearest
