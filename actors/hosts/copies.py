"""Which states of nodes are to be sent to another host, and which of those sent are taken. Pure.

A node that has its home on another host than the first may have to run on the first. So each of the
two holds the newest state that it has kept. They do not order what to do: each says again and again
what it holds (`Checkpoints.kept`) and adds copies of what is newer than the other said last. What
is lost, comes late, twice, or after another, changes nothing: whatever happened, the next message
says what is missing, and only what is newer is ever taken.

*Newer* is decided by incarnation, then generation. A node has one process of an incarnation, and
that counts its generations up, so no two states have the same two numbers.

A host where the node runs takes no copy but of a higher incarnation than its own: what runs there
is superseded then. And whoever gives a node back says which state is the last (`KeptState.final`),
so that the other waits for it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

from rampart.actors.ftm.messages import (
    LARGEST_COPY_BYTES,
    Checkpoints,
    KeptState,
    StateCopy,
)
from rampart.actors.hosts.placement import FIRST
from rampart.actors.runtime.checkpoint import Record
from rampart.actors.runtime.checkpoint_file import record_checksum

AT_ONCE_BYTES = 4096
"""A state that is not longer is in each message until the other host says that it holds it."""

AGAIN_S = 1.0
"""Real seconds after which a longer one is sent again."""

BATCH_BYTES = 64 << 10
"""Of states in one message, unless one alone is longer."""

Age = tuple[int, int]
_NONE: Age = (0, 0)


@dataclass(slots=True)
class _State:
    """What is known of the state of one node.

    Attributes:
        other: Host that holds it as well.
        mine: The newest here.
        theirs: What the other said last; None if nothing yet, or before it was lost.
        sent: Which was sent last, and when.
    """

    other: str
    mine: Record | None = None
    theirs: KeptState | None = None
    sent: tuple[Age, float] = (_NONE, 0.0)

    @property
    def age(self) -> Age:
        return self.mine.age if self.mine else _NONE

    def is_missed(self) -> bool:
        """Whether the other host lacks the newest one."""
        return (self.mine is not None and self.theirs is not None
                and len(self.mine.state) <= LARGEST_COPY_BYTES
                and self.mine.age > (self.theirs.incarnation, self.theirs.generation))


@dataclass(frozen=True, slots=True)
class Taken:
    """What comes of a message.

    Attributes:
        is_first: Whether that host had said nothing since it was lost, so it lacks an answer.
        records: To be kept here, each with its node.
        problems: What is wrong with it, each with the node that it is about.
    """

    is_first: bool = False
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

    @property
    def nodes(self) -> tuple[str, ...]:
        """Names of the nodes that it is about."""
        return tuple(self._states)

    def kept(self, node: str, record: Record | None) -> str:
        """Note the newest state of a node on this host's disk; return what is wrong with it."""
        self._states[node].mine = record
        if record is None or len(record.state) <= LARGEST_COPY_BYTES:
            return ""
        return (f"a state of {len(record.state)} bytes is not copied to another host; "
                f"{LARGEST_COPY_BYTES} can be")

    def unsettle(self, nodes: Iterable[str]) -> None:
        """Note that a process of nodes is being ended here: it may keep something yet."""
        self._unsettled.update(self._states.keys() & set(nodes))

    def settled(self, node: str) -> None:
        """Note that it has ended, and that what it has kept was noted."""
        self._unsettled.discard(node)

    def lost(self, host: str) -> None:
        """Note that a host is lost: what it said it holds may be past."""
        for state in self._states.values():
            if state.other == host:
                state.theirs = None

    def has_missed(self) -> bool:
        """Whether another host lacks something that can be sent to it."""
        return any(state.is_missed() for state in self._states.values())

    def told(self, host: str, message: Checkpoints) -> Taken:
        """Take what another host says; it is believed about nodes of which it holds the state.

        Args:
            host: Name of it.
            message: What its supervisor said.
        """
        if message.run != self._run:
            return Taken(problems=((host, f"checkpoints of run {message.run!r}"),))
        is_first = False
        for kept in message.kept:
            state = self._states.get(kept.node)
            if state is not None and state.other == host:
                is_first = is_first or state.theirs is None
                state.theirs = kept
        records, problems = list[tuple[str, Record]](), list[tuple[str, str]]()
        for copy in message.copies:
            state = self._states.get(copy.node)
            record = Record(copy.generation, copy.incarnation, copy.version, copy.state)
            if state is None and host == FIRST:
                continue  # for another host
            if state is None or state.other != host:
                problems.append((copy.node, f"a state from host {host or 'the first'}, which it "
                                 "may not keep"))
            elif checksum(self._run, copy.node, record) != copy.checksum:
                problems.append((copy.node, f"a copy of generation {copy.generation}: its checksum "
                                 "is wrong"))
            elif record.age > state.age and (
                    self._runs(copy.node) < copy.incarnation <= self._issued(copy.node)):
                records.append((copy.node, record))
        return Taken(is_first, tuple(records), tuple(problems))

    def message(self, now_s: float) -> Checkpoints:
        """Return what is to be told: what is held here, and copies of what others lack.

        Args:
            now_s: Now, real seconds; for what is not sent again at once.
        """
        kept = tuple(KeptState(
            node, *state.age, self._issued(node),
            not self._runs(node) and node not in self._unsettled)
            for node, state in self._states.items())
        copies, bytes_left = list[StateCopy](), BATCH_BYTES
        missed = [(state.sent[1], node) for node, state in self._states.items()
                  if state.is_missed()]
        for _, node in sorted(missed):  # what was sent longest ago first
            state = self._states[node]
            record = state.mine
            assert record is not None  # noqa: S101 for the type checker
            size, (age, sent_s) = len(record.state), state.sent
            if (size > AT_ONCE_BYTES and age == record.age and now_s - sent_s < AGAIN_S) or (
                    copies and size > bytes_left):
                continue
            copies.append(StateCopy(node, record.incarnation, record.generation, record.version,
                                    record.state, checksum(self._run, node, record)))
            state.sent = record.age, now_s
            bytes_left -= size
        return Checkpoints(self._run, kept, tuple(copies))

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
                    or (theirs.incarnation, theirs.generation) > state.age):
                return False
        return True


def checksum(run: str, node: str, record: Record) -> bytes:
    """Return what stands beside a copy: over all of it, and the node and the run that it is of."""
    return record_checksum(f"{run} {node}", record)
