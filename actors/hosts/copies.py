"""Copies of node states on two hosts: what to publish, and what to accept. Pure.

A node of another host may have to run on the first host. So both hold the newest state that either
has kept. Each repeats all of its states, and publishes at once what has changed since the last
repetition. A lost, late, repeated or reordered message does no harm: the next one carries the state
again, and only a newer state is accepted.

*Newer* is decided by incarnation, then generation (`Record.age`). A host that runs the node accepts
only a state of a higher incarnation than its own, since its process is superseded then. A host that
gives a node back marks the last state (`KeptState.final`), and its home waits for that.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

from rampart.actors.ftm.messages import LARGEST_STATE_BYTES, Checkpoints, KeptState
from rampart.actors.hosts.placement import FIRST
from rampart.actors.runtime.checkpoint import Record

_NONE = Record(0, 0, 0, 0, b"")


@dataclass(slots=True)
class _State:
    """Two copies of one node's state.

    Attributes:
        other: Host that holds the second copy.
        mine: The newest on this host.
        theirs: Last state from the other host; None if there is none since it was lost.
    """

    other: str
    mine: Record = _NONE
    theirs: KeptState | None = None


class Received(NamedTuple):
    """Result of a message: records to keep, and problems, each with the node's name."""

    records: tuple[tuple[str, Record], ...] = ()
    problems: tuple[tuple[str, str], ...] = ()


class Copies:
    """The states that one host shares with others.

    Args:
        run: Name of the run.
        own: Name of this host.
        home_of: Home of each node that may run on two hosts; the second is the first host.
        runs: Returns the highest incarnation of a node that this host runs; 0 for none.
        issued: Returns the highest incarnation of a node that is known to be issued.

    Attributes:
        nodes: Nodes that this host shares.
    """

    def __init__(self, run: str, own: str, home_of: Mapping[str, str],
                 runs: Callable[[str], int], issued: Callable[[str], int]) -> None:
        self._run = run
        self._runs = runs
        self._issued = issued
        self._states = {node: _State(FIRST if own == home else home)
                        for node, home in home_of.items() if own in {home, FIRST}}
        self.nodes = tuple(self._states)
        self._unsettled = set(self.nodes)
        self._changed: set[str] = set()

    def note_kept(self, node: str, record: Record | None) -> None:
        """Note the newest state of a node on this host's disk."""
        self._states[node].mine = record or _NONE
        self._changed.add(node)

    def unsettle(self, nodes: Iterable[str]) -> None:
        """Note that processes of nodes are being ended here, and may still keep a state."""
        self._unsettled.update(self._states.keys() & set(nodes))

    def settle(self, node: str) -> None:
        """Note that no process of a node is left here, and that its last state was noted."""
        self._unsettled.discard(node)

    def lose(self, host: str) -> None:
        """Forget what a lost host published."""
        for state in self._states.values():
            if state.other == host:
                state.theirs = None

    def receive(self, host: str, message: Checkpoints) -> Received:
        """Take the states that another host holds, of nodes that it may hold."""
        if message.run != self._run:
            return Received(problems=((host, f"checkpoints of run {message.run!r}, "
                                       f"expected {self._run!r}"),))
        records, problems = list[tuple[str, Record]](), list[tuple[str, str]]()
        for kept in message.kept:
            state = self._states.get(kept.node)
            if state is None and host == FIRST:
                continue  # for another host
            if state is None or state.other != host:
                problems.append((kept.node, f"host {host or 'the first'} published a state of this "
                                 "node, which it does not share"))
                continue
            state.theirs = kept
            if (_age(kept) > state.mine.age
                    and self._runs(kept.node) < kept.incarnation <= self._issued(kept.node)):
                records.append((kept.node, Record(kept.incarnation, kept.generation, kept.version,
                                                  kept.failures, kept.state)))
        return Received(tuple(records), tuple(problems))

    def changes(self) -> Checkpoints:
        """Return the states that have changed since all were repeated; a reader may skip some."""
        return self._message(self._changed)

    def all(self) -> Checkpoints:
        """Return all states; those that do not fit come first in the next message."""
        self._changed.clear()
        return self._message(tuple(self._states))

    def _message(self, nodes: Iterable[str]) -> Checkpoints:
        kept, bytes_left = list[KeptState](), LARGEST_STATE_BYTES
        for node in nodes:
            record = self._states[node].mine
            if len(record.state) <= bytes_left:
                bytes_left -= len(record.state)
                kept.append(KeptState(node, *record, self._issued(node),
                                      not self._runs(node) and node not in self._unsettled))
        for state in kept:
            self._states[state.node] = self._states.pop(state.node)  # to the end
        return Checkpoints(self._run, tuple(kept))

    def is_caught_up(self, issued: Mapping[str, int]) -> bool:
        """Whether the last states of nodes that another host has given back are on this disk.

        Args:
            issued: The nodes, each with the highest incarnation that the other host has issued.
        """
        for node, incarnation in issued.items():
            if state := self._states.get(node):
                theirs = state.theirs
                if (theirs is None or not theirs.final or theirs.issued < incarnation
                        or _age(theirs) > state.mine.age):
                    return False
        return True


def _age(state: KeptState) -> tuple[int, int]:
    return state.incarnation, state.generation
