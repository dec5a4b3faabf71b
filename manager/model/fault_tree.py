"""The fault tree, and the FTMTree that follows from where mechanisms sit in it.

A fault tree says how unwanted events combine into the top event (IEC 61025). Each FTM is a
barrier on one event: it is meant to keep that event from going further up. The FTMTree needs no
declaration of its own, it is read off the tree (paper, figures 6 and 8a): *the parent of an FTM
is the nearest FTM above it*.

An event may feed several gates: it is a common cause then. But a mechanism must have one
parent, otherwise "the lowest common dominant" of block 4 is not defined; so what is refused is
not the shared event but a mechanism whose ways up end at two different ones.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from graphlib import TopologicalSorter

import msgspec

from rampart.manager.model.order import Tree, find_cycle


class FaultTreeError(ValueError):
    """Events and mechanisms that make no tree.

    Attributes:
        subject: Name of the event or mechanism to blame.
    """

    def __init__(self, subject: str, problem: str) -> None:
        self.subject = subject
        super().__init__(problem)


class Event(msgspec.Struct, frozen=True):
    """An unwanted event.

    A gate is the number of inputs that must occur: 1 is OR, all is AND, anything between is
    at-least-k. A basic event has no inputs, and `required` is 0.
    """

    name: str
    inputs: tuple[str, ...] = ()
    required: int = 0


class FaultTree:
    """Events joined by gates, with exactly one top.

    Args:
        events: All events, in any sequence, each name once and with its inputs.

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
            raise FaultTreeError("", "no events; exactly one top event is needed")
        if len(tops) > 1:
            raise FaultTreeError(tops[1], f"unreachable from the top event {tops[0]!r}; exactly "
                                          "one event may be no input of any gate")
        self.top = tops[0]
        self._upwards = tuple(TopologicalSorter(inputs).static_order())

    def _join(self, event: Event) -> None:
        if event.required and not event.inputs:
            raise FaultTreeError(event.name, "gate without inputs; list its causes in 'of'")
        if not 0 <= event.required <= len(event.inputs) or bool(event.inputs) > event.required:
            raise FaultTreeError(event.name, f"gate needs {event.required} of "
                                             f"{len(event.inputs)} inputs")
        for name in event.inputs:
            if event.name in self.parents[name][-1:]:
                raise FaultTreeError(event.name, f"input {name!r} is listed twice")
            self.parents[name].append(event.name)

    def occurring(self, given: Iterable[str], prevented: str = "") -> set[str]:
        """Return all events that occur when the given ones do and one is prevented."""
        occurring = set(given) - {prevented}
        for name in self._upwards:
            event = self.events[name]
            if name != prevented and event.required \
                    and sum(entry in occurring for entry in event.inputs) >= event.required:
                occurring.add(name)
        return occurring

    def derive_ftm_tree(self, placement: Mapping[str, str]) -> Tree:
        """Derive the FTMTree from the event on which each mechanism sits.

        Args:
            placement: Mechanism name to event name.

        Raises:
            FaultTreeError: Two mechanisms on one event (neither would be nearer to the top),
                several parents, or not exactly one root.
        """
        at: dict[str, str] = {}
        for mechanism, event in placement.items():
            if event in at:
                raise FaultTreeError(mechanism, f"event {event!r} already holds {at[event]}; put "
                                     "an event between them to say which is nearer to the top")
            at[event] = mechanism
        nearest = self._nearest_mechanisms(at)
        parents: dict[str, str | None] = {}
        for mechanism, event in placement.items():
            above = nearest[event]
            if len(above) > 1:
                found = ", ".join(sorted(name or "none" for name in above))
                raise FaultTreeError(mechanism, f"several parents in the FTMTree: {found}; event "
                                     f"{event!r} has a way to the top past each of them")
            parents[mechanism] = next(iter(above)) or None
        roots = [mechanism for mechanism, parent in parents.items() if parent is None]
        if len(roots) != 1:
            raise FaultTreeError(roots[1] if roots else "", (
                f"the FTMTree has {len(roots)} roots: {', '.join(roots) or 'none'}; exactly one "
                "mechanism may have no other above it, e.g. one on the top event"))
        return Tree(parents)

    def _nearest_mechanisms(self, at: Mapping[str, str]) -> dict[str, frozenset[str]]:
        """Return, for each event, the first mechanisms met on all its ways to the top.

        A way that meets none contributes the empty name: a mechanism that can be bypassed
        dominates nothing, so this must not be mistaken for a parent.
        """
        nearest = {self.top: frozenset({""})}
        for event in TopologicalSorter(self.parents).static_order():
            if event != self.top:
                nearest[event] = frozenset().union(*(
                    {at[parent]} if parent in at else nearest[parent]
                    for parent in self.parents[event]))
        return nearest
