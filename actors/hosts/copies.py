"""Which states of nodes are to be sent to another host, and which of those sent are taken. Pure.

A node that has its home on another host than the first may have to run on the first. So each of the
two holds the newest state that it has kept. They do not order what to do: each says again and again
what it holds (`Checkpoints.kept`) and adds copies of what is newer than the other said last. What
is lost, comes late, twice, or after another, changes nothing: whatever happened, the next message
says what is missing, and only what is newer is ever taken.

*Newer* is decided by incarnation, then generation. A node has one process of an incarnation, and
that counts its generations up, so no two states have the same two numbers.

A long state goes in parts, the next one when the other host has said that the one before is there
(`rampart.actors.hosts.parts`).

A host where the node runs takes no copy but of a higher incarnation than its own: what runs there
is superseded then. And whoever gives a node back says which state is the last (`KeptState.final`),
so that the other waits for it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import msgspec

from rampart.actors.ftm.messages import (
    PART_BYTES,
    Checkpoints,
    KeptState,
    StateCopy,
)
from rampart.actors.hosts.parts import Age, Coming, Going, Line, whole
from rampart.actors.hosts.placement import FIRST
from rampart.actors.runtime.checkpoint import Record
from rampart.actors.runtime.checkpoint_file import LARGEST_STATE_BYTES, record_checksum

AT_ONCE_BYTES = 4096
"""A state that is not longer is in each message until the other host says that it holds it."""

AGAIN_S = 1.0
"""Real seconds after which a part that was not answered is sent again."""

_NONE: Age = (0, 0)


@dataclass(slots=True)
class _State:
    """What is known of the state of one node.

    Attributes:
        other: Host that holds it as well.
        mine: The newest here.
        theirs: What the other said last; None if nothing yet, or before it was lost.
        coming: A newer one that is under way to here.
        sent_s: When some of it was sent last.
    """

    other: str
    mine: Record | None = None
    theirs: KeptState | None = None
    coming: Coming | None = None
    sent_s: float = 0.0

    @property
    def age(self) -> Age:
        return self.mine.age if self.mine else _NONE

    @property
    def their_age(self) -> Age:
        return (self.theirs.incarnation, self.theirs.generation) if self.theirs else _NONE

    def is_missed(self) -> bool:
        """Whether the other host lacks the newest one."""
        return self.mine is not None and self.theirs is not None and self.mine.age > self.their_age

    def is_long(self) -> bool:
        """Whether the newest one goes in parts."""
        return self.mine is not None and len(self.mine.state) > AT_ONCE_BYTES


@dataclass(frozen=True, slots=True)
class Taken:
    """What comes of a message.

    Attributes:
        wants_answer: Whether that host waits for one: it had said nothing since it was lost, or
            a part of a state has come from it, or come there.
        records: To be kept here, each with its node.
        problems: What is wrong with it, each with the node that it is about.
    """

    wants_answer: bool = False
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
        self._going: dict[str, Going] = {}
        self._lines = {state.other: Line() for state in self._states.values()}

    @property
    def nodes(self) -> tuple[str, ...]:
        """Names of the nodes that it is about."""
        return tuple(self._states)

    def kept(self, node: str, record: Record | None) -> None:
        """Note the newest state of a node on this host's disk."""
        state = self._states[node]
        state.mine = record
        if state.coming is not None and state.coming.age <= state.age:
            state.coming = None

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
        if host in self._lines:
            self._lines[host] = Line()

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
        wants_answer = False
        for kept in message.kept:
            state = self._states.get(kept.node)
            if state is not None and state.other == host:
                wants_answer = wants_answer or state.theirs is None
                state.theirs = kept
        going = self._going.get(host)
        if going is not None and self._has_come(going) > going.there:
            wants_answer = True
        records, problems = list[tuple[str, Record]](), list[tuple[str, str]]()
        for copy in message.copies:
            state = self._states.get(copy.node)
            if state is None and host == FIRST:
                continue  # for another host
            if state is None or state.other != host:
                problems.append((copy.node, f"a state from host {host or 'the first'}, which it "
                                 "may not keep"))
                continue
            wants_answer = wants_answer or copy.size > AT_ONCE_BYTES
            try:
                record = self._put_together(state, copy)
            except ValueError as error:
                problems.append((copy.node, f"a copy of generation {copy.generation}: {error}"))
                continue
            if record is not None and self._is_taken(state, copy):
                records.append((copy.node, record))
        return Taken(wants_answer, tuple(records), tuple(problems))

    def _is_taken(self, state: _State, copy: StateCopy) -> bool:
        """Whether a copy is newer, and of what may have been kept by a process of its node."""
        return (copy.incarnation, copy.generation) > state.age and (
            self._runs(copy.node) < copy.incarnation <= self._issued(copy.node))

    def _put_together(self, state: _State, copy: StateCopy) -> Record | None:
        """Return the whole state, if with this part all of it is here.

        Raises:
            ValueError: it is not what was sent.
        """
        if copy.size > LARGEST_STATE_BYTES:
            raise ValueError(f"{copy.size} bytes; {LARGEST_STATE_BYTES} can be kept")
        data: bytes | bytearray = copy.state
        if copy.size > AT_ONCE_BYTES:
            if not self._is_taken(state, copy):
                return None
            if state.coming is None or state.coming.gives_way_to(copy):
                state.coming = Coming(whole(copy))
            data = state.coming.with_part(copy)
            if len(data) < copy.size:
                return None
        record = Record(copy.generation, copy.incarnation, copy.version, bytes(data))
        if len(data) != copy.size or checksum(self._run, copy.node, record) != copy.checksum:
            state.coming = None
            raise ValueError("its checksum is wrong")
        return record

    def message(self, now_s: float) -> Checkpoints:
        """Return what is to be told: what is held here, and copies of what others lack.

        Args:
            now_s: Now, real seconds; for what is not sent again at once.
        """
        kept = tuple(self._held(node, state) for node, state in self._states.items())
        copies, bytes_left = list[StateCopy](), PART_BYTES
        missed = [(state.sent_s, node) for node, state in self._states.items()
                  if state.is_missed() and not state.is_long()]
        for _, node in sorted(missed):  # what was sent longest ago first
            state = self._states[node]
            assert state.mine is not None  # noqa: S101 for the type checker
            size = len(state.mine.state)
            if size <= bytes_left:
                check = checksum(self._run, node, state.mine)
                copies.append(_copy(node, state.mine, check, 0, size))
                state.sent_s = now_s
                bytes_left -= size
        for host in self._lines:
            copies += self._next_part(host, now_s)
        return Checkpoints(self._run, kept, tuple(copies))

    def _held(self, node: str, state: _State) -> KeptState:
        held = KeptState(node, *state.age, self._issued(node),
                         not self._runs(node) and node not in self._unsettled)
        if state.coming is None:
            return held
        incarnation, generation = state.coming.age
        return msgspec.structs.replace(
            held, coming_incarnation=incarnation, coming_generation=generation,
            coming_bytes=len(state.coming.data))

    # -- in parts -------------------------------------------------------------------------------

    def _has_come(self, going: Going) -> int:
        """Return how many bytes of a state the other host says that it has."""
        theirs = self._states[going.node].theirs
        if theirs is None or going.record.age != (
                theirs.coming_incarnation, theirs.coming_generation):
            return 0
        return min(theirs.coming_bytes, len(going.record.state))

    def _next_part(self, host: str, now_s: float) -> list[StateCopy]:
        """Return what is to be sent now of a long state, if anything is: one goes at a time."""
        going = self._still_going(host, now_s) or self._starting(host)
        if going is None:
            return []
        there, size, line = self._has_come(going), len(going.record.state), self._lines[host]
        if going.sent_s is not None:
            passed_s, is_answered = now_s - going.sent_s, there > going.there
            if passed_s < AGAIN_S and not is_answered:
                return []
            if passed_s < AGAIN_S and there == size:
                going.there = there  # all of it: the other host will say that it is kept
                return []
            if is_answered:
                line.answered(passed_s)
            else:
                line.missed()
        going.there, going.sent_s = there, now_s
        self._states[going.node].sent_s = now_s
        begin = min(there, size - 1)  # the last byte again has it kept, should that have failed
        return [_copy(going.node, going.record, going.checksum, begin, begin + line.part_bytes)]

    def _still_going(self, host: str, now_s: float) -> Going | None:
        """Return the state that is under way to a host, unless it is of no more use there."""
        going = self._going.get(host)
        if going is None:
            return None
        state, record = self._states[going.node], going.record
        is_vain = not self._has_come(going) and now_s - (going.sent_s or now_s) >= AGAIN_S
        if state.theirs is None or state.mine is None or record.age <= state.their_age or (
                state.mine.age > record.age
                and (state.mine.incarnation != record.incarnation or is_vain)):
            del self._going[host]
            return None
        return going

    def _starting(self, host: str) -> Going | None:
        missed = [(state.sent_s, node) for node, state in self._states.items()
                  if state.other == host and state.is_missed() and state.is_long()]
        if not missed:
            return None
        node = min(missed)[1]
        record = self._states[node].mine
        assert record is not None  # noqa: S101 for the type checker
        going = self._going[host] = Going(node, record, checksum(self._run, node, record))
        return going

    def come(self, nodes: Iterable[str]) -> tuple[tuple[Age, int], ...]:
        """Return what has come of the states of nodes; it changes with each part that comes."""
        states = [self._states[node] for node in nodes if node in self._states]
        return tuple((state.coming.age, len(state.coming.data)) if state.coming else (state.age, 0)
                     for state in states)

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


def _copy(node: str, record: Record, check: bytes, offset: int, end: int) -> StateCopy:
    return StateCopy(node, record.incarnation, record.generation, record.version,
                     len(record.state), offset, record.state[offset:end], check)
