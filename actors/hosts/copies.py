"""Which states of nodes are to be sent to another host, and which of those sent are taken. Pure.

A node that has its home on another host than the first may have to run on the first. So each of the
two holds the newest state that it has kept. They give each other no orders: each repeats what it
holds (`Checkpoints.kept`) and adds copies of what is newer than the other published last. What is
lost, comes late, twice, or after another, changes nothing: the next message shows what is missing,
and only what is newer is ever taken.

*Newer* is decided by incarnation, then generation (`Record.age`). A host where the node runs takes
no copy but of a higher incarnation than its own: what runs there is superseded then. A host that
gives a node back marks which state is the last (`KeptState.final`), so that the other waits for it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

from rampart.actors.ftm.messages import LARGEST_STATE_BYTES, Checkpoints, KeptState, StateCopy
from rampart.actors.hosts.placement import FIRST
from rampart.actors.runtime.checkpoint import Record

AGAIN_S = 1.0
"""Real seconds after which a copy is sent again that the other host does not hold yet."""

_NONE = 0, 0


@dataclass(slots=True)
class _State:
    """What is known of the state of one node.

    Attributes:
        other: Host that holds it as well.
        mine: The newest here.
        theirs: What the other published last; None if nothing yet, or before it was lost.
        sent: Age of the copy that was sent last.
        sent_s: When that was.
    """

    other: str
    mine: Record | None = None
    theirs: KeptState | None = None
    sent: tuple[int, int] = _NONE
    sent_s: float = 0.0

    @property
    def age(self) -> tuple[int, int]:
        return self.mine.age if self.mine else _NONE

    def missed(self, now_s: float) -> Record | None:
        """Return the newest one if the other host lacks it, and it was not just sent."""
        if self.mine is None or self.theirs is None or self.age <= _age(self.theirs):
            return None
        return None if self.sent == self.age and now_s - self.sent_s < AGAIN_S else self.mine


@dataclass(frozen=True, slots=True)
class Taken:
    """What comes of a message.

    Attributes:
        wants_answer: Whether that host had published nothing since it was lost.
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

    @property
    def nodes(self) -> tuple[str, ...]:
        """Names of the nodes that it is about."""
        return tuple(self._states)

    def kept(self, node: str, record: Record | None) -> None:
        """Note the newest state of a node on this host's disk."""
        self._states[node].mine = record

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
                state.theirs, state.sent = None, _NONE

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
        records, problems = list[tuple[str, Record]](), list[tuple[str, str]]()
        for copy in message.copies:
            state = self._states.get(copy.node)
            if state is None and host == FIRST:
                continue  # for another host
            if state is None or state.other != host:
                problems.append((copy.node, f"a state from host {host or 'the first'}, which it "
                                 "may not keep"))
            elif (_age(copy) > state.age
                  and self._runs(copy.node) < copy.incarnation <= self._issued(copy.node)):
                records.append((copy.node, Record(copy.incarnation, copy.generation, copy.version,
                                                  copy.failures, copy.state)))
        return Taken(wants_answer, tuple(records), tuple(problems))

    def message(self, now_s: float) -> Checkpoints:
        """Return what is to be published: what is held here, and copies of what others lack.

        Args:
            now_s: Now, real seconds; for what is not sent again at once.
        """
        kept = tuple(KeptState(node, *state.age, self._issued(node),
                               not self._runs(node) and node not in self._unsettled)
                     for node, state in self._states.items())
        copies, bytes_left = list[StateCopy](), LARGEST_STATE_BYTES
        for node, state in sorted(self._states.items(), key=lambda item: item[1].sent_s):
            record = state.missed(now_s)
            if record is not None and len(record.state) <= bytes_left:
                copies.append(StateCopy(node, *record))
                state.sent, state.sent_s = record.age, now_s
                bytes_left -= len(record.state)
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
                    or _age(theirs) > state.age):
                return False
        return True


def _age(state: KeptState | StateCopy) -> tuple[int, int]:
    return state.incarnation, state.generation
