"""Which states of nodes another host is sent, and which of those it sends are taken. Pure.

A node that has its home on another host than the first may have to run on the first. So each of the
two holds the newest state that it has kept. Each repeats what it holds (`Checkpoints`), and at once
what has changed since it repeated all. Lost, late, double and disordered messages do no harm: the
next one has the state again, and only what is newer is ever taken.

*Newer* is decided by incarnation, then generation (`Record.age`). A host where the node runs takes
no state but of a higher incarnation than its own: what runs there is superseded then. A host that
gives a node back marks which state is the last (`KeptState.final`), so that the other waits for it.
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
    """What is known of the state of one node.

    Attributes:
        other: Host that holds it as well.
        mine: The newest here.
        theirs: What the other published last; None if nothing yet, or before it was lost.
    """

    other: str
    mine: Record = _NONE
    theirs: KeptState | None = None


class Taken(NamedTuple):
    """What comes of a message.

    Attributes:
        records: To be kept here, each with its node.
        problems: What is wrong with it, each with the node that it is about.
    """

    records: tuple[tuple[str, Record], ...] = ()
    problems: tuple[tuple[str, str], ...] = ()


class Copies:
    """What one host knows of the states that it shares with others.

    Args:
        run: Name of the run.
        own: Name of the host.
        home_of: Of each node that may run on two hosts, the name of the one that is its home; that
            is not the first, which is the other.
        runs: Returns the highest incarnation of a node that this host runs; 0 if it does not.
        issued: Returns the highest incarnation of a node that is known to have been issued.
    """

    def __init__(self, run: str, own: str, home_of: Mapping[str, str],
                 runs: Callable[[str], int], issued: Callable[[str], int]) -> None:
        self._run = run
        self._runs = runs
        self._issued = issued
        self._states = {node: _State(FIRST if own == home else home)
                        for node, home in home_of.items() if own in {home, FIRST}}
        self._unsettled = set(self._states)
        self._changed: set[str] = set()

    @property
    def nodes(self) -> tuple[str, ...]:
        """Names of the nodes that it is about."""
        return tuple(self._states)

    def kept(self, node: str, record: Record | None) -> None:
        """Note the newest state of a node on this host's disk."""
        self._states[node].mine = record or _NONE
        self._changed.add(node)

    def unsettle(self, nodes: Iterable[str]) -> None:
        """Note that a process of nodes is being ended here: it may keep something yet."""
        self._unsettled.update(self._states.keys() & set(nodes))

    def settled(self, node: str) -> None:
        """Note that it has ended, and that what it has kept was noted."""
        self._unsettled.discard(node)

    def lost(self, host: str) -> None:
        """Note that a host is lost: what it published may be past."""
        for state in self._states.values():
            if state.other == host:
                state.theirs = None

    def told(self, host: str, message: Checkpoints) -> Taken:
        """Take what another host holds; it is believed about nodes of which it holds the state.

        Args:
            host: Name of it.
            message: From its supervisor.
        """
        if message.run != self._run:
            return Taken(problems=((host, f"checkpoints of run {message.run!r}"),))
        records, problems = list[tuple[str, Record]](), list[tuple[str, str]]()
        for kept in message.kept:
            state = self._states.get(kept.node)
            if state is None and host == FIRST:
                continue  # for another host
            if state is None or state.other != host:
                problems.append((kept.node, f"a state from host {host or 'the first'}, which it "
                                 "may not keep"))
                continue
            state.theirs = kept
            if (_age(kept) > state.mine.age
                    and self._runs(kept.node) < kept.incarnation <= self._issued(kept.node)):
                records.append((kept.node, Record(kept.incarnation, kept.generation, kept.version,
                                                  kept.failures, kept.state)))
        return Taken(tuple(records), tuple(problems))

    def changes(self) -> Checkpoints:
        """Return what has changed since all was repeated."""
        return self._message(self._changed)

    def all(self) -> Checkpoints:
        """Return all that is held here; what a message has no room for comes with the next."""
        self._changed.clear()
        return self._message(tuple(self._states))

    def _message(self, nodes: Iterable[str]) -> Checkpoints:
        kept, bytes_left = list[KeptState](), LARGEST_STATE_BYTES
        for node in nodes:
            record = self._states[node].mine
            if len(record.state) > bytes_left:
                continue
            bytes_left -= len(record.state)
            kept.append(KeptState(
                node, *record, self._issued(node),
                not self._runs(node) and node not in self._unsettled))
        for one in kept:  # to the end: the next message begins with what was left out
            self._states[one.node] = self._states.pop(one.node)
        return Checkpoints(self._run, tuple(kept))

    def is_caught_up(self, nodes: Iterable[str], issued: Mapping[str, int]) -> bool:
        """Whether the last states that another host has kept of its nodes are here.

        Args:
            nodes: That it has given back.
            issued: Highest incarnation of each that it has said it issued; 0 if none.
        """
        for node in nodes:
            state = self._states.get(node)
            if state is None:
                continue
            theirs = state.theirs
            if (theirs is None or not theirs.final or theirs.issued < issued.get(node, 0)
                    or _age(theirs) > state.mine.age):
                return False
        return True


def _age(state: KeptState) -> tuple[int, int]:
    return state.incarnation, state.generation
