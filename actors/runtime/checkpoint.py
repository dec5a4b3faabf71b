"""The state that a node keeps across its incarnations: its format, and the rules for keeping it.

A node keeps its whole state, never a change of it, so any one sound checkpoint is enough. It keeps
the state *before* it sends the message that follows from it (write-ahead). So no other node knows
more than the newest checkpoint. A `StateFormat` converts states to bytes and back. A
`CheckpointStore` keeps the last few generations of one node. A `Keeper` stands between them and the
actor: no failure of a checkpoint ends a node.

The paper's controller has no checkpoints ("it hasn't been implemented yet", section V-B): its nodes
have no store.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, NamedTuple, Protocol, TypeVar

import msgspec

from rampart.actors.ftm.messages import LARGEST_STATE_BYTES

S = TypeVar("S", bound=msgspec.Struct)

GENERATIONS = 4
"""States of each node that are kept."""

FAILED_IN_A_ROW = 3
"""A node starts idle after this many processes in a row failed soon after they loaded the state."""

SOON_S = 10.0
"""A failure within this time of the start, in simulated seconds, counts against the state."""

RETRY_S = (1.0, 30.0)
"""First and longest pause, in simulated seconds, before a failed save is tried again."""


class CheckpointError(OSError):
    """A state could not be saved or loaded; the text is one line with file and reason."""


class SupersededError(CheckpointError):
    """A newer incarnation of the node has loaded or saved; this one saves nothing."""


class StateError(ValueError):
    """Bytes are not a state of this node; the text is one line with the reason."""


class Record(NamedTuple):
    """One generation of a node's state.

    Attributes:
        incarnation: of the process that saved it.
        generation: number of the state, counted through all incarnations.
        version: of the state's format.
        failures: how many processes in a row failed soon after their start, up to this one.
        state: the state as bytes.
    """

    incarnation: int
    generation: int
    version: int
    failures: int
    state: bytes

    @property
    def age(self) -> tuple[int, int]:
        """Sort key: the greater one of two states of a node is newer."""
        return self.incarnation, self.generation


class Loaded(NamedTuple):
    """A store's content: sound records, newest first, and one line for each damage."""

    records: tuple[Record, ...] = ()
    problems: tuple[str, ...] = ()


class CheckpointStore(Protocol):
    """Keeps the states of one node, for one of its incarnations."""

    def load(self) -> Loaded:
        """Return the states that are there.

        Raises:
            SupersededError: a newer incarnation has loaded or saved.
            CheckpointError: the states cannot be read.
        """

    def save(self, version: int, failures: int, state: bytes) -> None:
        """Save a state, completely or not at all; after the return it survives the process.

        Raises:
            CheckpointError: it could not be saved; the previous states are still there.
        """

    def trouble(self) -> str:
        """Return what has failed in the background since the last call, or ""."""
        return ""

    def close(self) -> None:
        """Release what is open. Harmless when repeated."""


class MemoryCheckpoints(CheckpointStore):
    """Keeps states in a list that outlives virtual processes.

    Args:
        shelf: the node's records, newest first; shared by its incarnations.
        incarnation: number of this process of the node.
    """

    def __init__(self, shelf: list[Record], incarnation: int) -> None:
        self._shelf = shelf
        self._incarnation = incarnation

    def load(self) -> Loaded:
        """Return the states on the shelf; see `CheckpointStore`."""
        if self._shelf and self._shelf[0].incarnation > self._incarnation:
            raise SupersededError(f"incarnation {self._incarnation} was superseded")
        return Loaded(tuple(self._shelf))

    def save(self, version: int, failures: int, state: bytes) -> None:
        """Put a state on the shelf."""
        generation = 1 + max((record.generation for record in self._shelf), default=0)
        self._shelf.append(Record(self._incarnation, generation, version, failures, state))
        self._shelf.sort(key=lambda record: record.age, reverse=True)
        del self._shelf[GENERATIONS:]

    def close(self) -> None:
        """Nothing is open."""


@dataclass(frozen=True, slots=True)
class StateFormat(Generic[S]):
    """Format of the states of one kind of node: msgpack of a struct.

    A new field with a default needs no new version, since older states decode with it. Every other
    change does. States of another version are not read.

    Attributes:
        kind: the struct.
        version: of its shape, from 1.
        objection: returns why a state that decodes makes no sense, or "".
    """

    kind: type[S]
    version: int = 1
    objection: Callable[[S], str] = lambda _state: ""

    def __post_init__(self) -> None:
        """Read the struct's annotations now, not in each process that loads a state."""
        msgspec.msgpack.Decoder(self.kind)

    def encode(self, state: S) -> bytes:
        """Return a state as bytes."""
        return msgspec.msgpack.encode(state)

    def decode(self, version: int, data: bytes) -> S:
        """Return the state that the bytes of a version encode.

        Raises:
            StateError: another version, bytes that do not decode, or a state that makes no sense.
        """
        if version != self.version:
            raise StateError(f"version {version}, expected {self.version}")
        try:
            state = msgspec.msgpack.decode(data, type=self.kind)
            objection = self.objection(state)
        except Exception as error:  # `objection` may raise anything on a senseless state
            raise StateError(f"not a {self.kind.__name__}: {in_words(error)}") from None
        if objection:
            raise StateError(f"a {self.kind.__name__} that makes no sense: {objection}")
        return state


class Keeper:
    """Saves and loads an actor's state; reports each failure and raises none.

    Args:
        store: where the states are; None keeps nothing.
        report: takes one line for the operator.
        now: returns simulated time.
        expected: whether a state should be there, since another process came before this one.
    """

    def __init__(self, store: CheckpointStore | None, report: Callable[[str], None],
                 now: Callable[[], float], *, expected: bool) -> None:
        self._store = store
        self._report = report
        self._now = now
        self._expected = expected
        self._began_s = now()
        self._failures = 0
        self._newest: tuple[int, bytes] | None = None
        self._is_kept = False
        self._problem = ""
        self._retry_at_s = -math.inf
        self._pause_s = RETRY_S[0]

    def kept(self, form: StateFormat[S]) -> S | None:
        """Return the newest sound state; None if there is none, and the node has to start idle."""
        if self._store is None:
            return None
        self._began_s = self._now()
        try:
            return self._find(form, self._store.load())
        except Exception as error:  # whatever lies on the disk, the node starts
            if isinstance(error, SupersededError):
                self._store = None
            self._report(f"{in_words(error)}; starting without a checkpoint")
            return None

    def _find(self, form: StateFormat[S], loaded: Loaded) -> S | None:
        records, problems = loaded.records, list(loaded.problems)
        if records and records[0].failures >= FAILED_IN_A_ROW:
            self._report(f"{records[0].failures} processes in a row failed with the saved state; "
                         "starting without it")
            return None
        state = None
        for record in records:
            try:
                state = form.decode(record.version, record.state)
            except StateError as error:
                problems.append(f"generation {record.generation}: {error}")
                continue
            self._failures, self._newest = record.failures, (record.version, record.state)
            break
        if problems or (state is None and self._expected):
            start = ("starting without a checkpoint" if state is None
                     else "taking the newest sound one")
            self._report(f"{'; '.join(problems) or 'no checkpoint was found'}; {start}")
        return state

    def keep(self, form: StateFormat[S], state: S) -> None:
        """Save a state, unless it is the one that was saved last."""
        if self._store is None:
            return
        newest = form.version, form.encode(state)
        if (self._is_kept and newest == self._newest) or self._now() < self._retry_at_s:
            return
        if self._failures and self._now() - self._began_s > SOON_S:
            self._failures = 0
        try:
            trouble = self._save(self._store, newest)
        except Exception as error:
            self._is_kept = False
            self._retry_at_s = self._now() + self._pause_s
            self._pause_s = min(2 * self._pause_s, RETRY_S[1])
            self._report_once(f"{in_words(error)}; going on without checkpoints")
            return
        self._pause_s = RETRY_S[0]
        if trouble:
            self._report_once(trouble)
        elif self._problem:
            self._problem = ""
            self._report("checkpoints are kept again")

    def failed(self) -> None:
        """Record that this process failed."""
        if self._store is None or self._newest is None:
            return
        soon = self._now() - self._began_s <= SOON_S
        self._failures = self._failures + 1 if soon else 0
        try:
            self._save(self._store, self._newest)
        except Exception as error:
            self._report_once(in_words(error))

    def close(self) -> None:
        """Close the store."""
        if self._store is not None:
            self._store.close()

    def _save(self, store: CheckpointStore, newest: tuple[int, bytes]) -> str:
        """Save a state and return what has failed in the background."""
        version, data = newest
        if len(data) > LARGEST_STATE_BYTES:
            raise CheckpointError(f"state of {len(data)} bytes, expected at most "
                                  f"{LARGEST_STATE_BYTES}")
        store.save(version, self._failures, data)
        self._newest, self._is_kept = newest, True
        return store.trouble()

    def _report_once(self, problem: str) -> None:
        if problem != self._problem:
            self._problem = problem
            self._report(problem)


def in_words(error: Exception) -> str:
    """Return an error as one short printable line, which may quote the data that caused it."""
    text = " ".join(str(error).split())
    if not isinstance(error, CheckpointError):
        text = f"{type(error).__name__}: {text}"
    return "".join(c if c.isprintable() else "?" for c in text)[:200]
