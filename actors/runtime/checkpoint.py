"""What a node must not forget: the format of its state, and the rules by which it is kept.

A node keeps the whole of its state, never a change to it, so any one sound checkpoint is enough.
It is kept *before* the message that follows from it is sent (write-ahead), so what others have
received is never newer than the newest checkpoint. A `StateFormat` turns states into bytes and
back; a `CheckpointStore` keeps the last few generations of one node's bytes; a `Keeper` stands
between them and the actor: no trouble with checkpoints ends a node.

The paper's controller has no checkpoints ("it hasn't been implemented yet", section V-B), and
`NoCheckpoints` is that controller.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, NamedTuple, TypeVar

import msgspec

from rampart.actors.ftm.messages import LARGEST_STATE_BYTES

S = TypeVar("S", bound=msgspec.Struct)

GENERATIONS = 4
"""So many generations of each node can be gone back to."""

FAILED_IN_A_ROW = 3
"""After so many processes in a row that failed soon after their start with the state kept, the
node starts idle rather than in a loop of crashes."""

SOON_S = 10.0
"""A failure within so many simulated seconds of the start is put down to the state loaded."""

RETRY_S = (1.0, 30.0)
"""Simulated seconds after which a save that failed is tried again: the first pause, and the
longest."""


class CheckpointError(OSError):
    """A state could not be kept or found; the text is one line that names file and reason."""


class SupersededError(CheckpointError):
    """A newer incarnation of the node has kept a state; this one keeps none."""


class StateError(ValueError):
    """Bytes that are not a state of this node; the text is one line that says why."""


class Record(NamedTuple):
    """One generation of a node's state.

    Attributes:
        incarnation: of the process that kept it.
        generation: number of the state, counted through all incarnations.
        version: of the state's format.
        failures: processes in a row that failed soon after their start, up to this one.
        state: the bytes.
    """

    incarnation: int
    generation: int
    version: int
    failures: int
    state: bytes

    @property
    def age(self) -> tuple[int, int]:
        """Of two states of a node the one with the greater age is newer."""
        return self.incarnation, self.generation


class Loaded(NamedTuple):
    """What a store holds of a node: sound records, newest first, and one line for each damage."""

    records: tuple[Record, ...] = ()
    problems: tuple[str, ...] = ()


class CheckpointStore:
    """Keeps the states of one node, for one of its incarnations.

    This class itself keeps nothing: see `NoCheckpoints`.
    """

    def load(self) -> Loaded:
        """Return what was kept.

        Raises:
            SupersededError: a newer incarnation has kept a state.
            CheckpointError: it cannot be read.
        """
        return Loaded()

    def save(self, version: int, failures: int, state: bytes) -> None:
        """Keep a state, whole or not at all; after the return it survives the process.

        Raises:
            CheckpointError: it could not be kept; the previous states are still there.
        """

    def trouble(self) -> str:
        """Return what went wrong in the background since the last call; "" if nothing."""
        return ""

    def close(self) -> None:
        """Release all that is open. Harmless when repeated."""


class NoCheckpoints(CheckpointStore):
    """Keeps nothing: a respawned node starts afresh, as in the paper."""


class MemoryCheckpoints(CheckpointStore):
    """Keeps states in a list that outlives virtual processes.

    Args:
        shelf: The node's records; shared by its incarnations.
        incarnation: Which process of the node this is.
    """

    def __init__(self, shelf: list[Record], incarnation: int) -> None:
        self._shelf = shelf
        self._incarnation = incarnation

    def load(self) -> Loaded:
        """Return what was kept."""
        if self._shelf and self._shelf[0].incarnation > self._incarnation:
            raise SupersededError(f"incarnation {self._incarnation} was superseded")
        return Loaded(tuple(self._shelf))

    def save(self, version: int, failures: int, state: bytes) -> None:
        """Keep a state."""
        generation = 1 + max((record.generation for record in self._shelf), default=0)
        record = Record(self._incarnation, generation, version, failures, state)
        self._shelf[:] = newest_first([*self._shelf, record])


def newest_first(records: list[Record]) -> list[Record]:
    """Return the generations that are kept of a node's records, newest first, each once."""
    known = {record.age: record for record in records}
    return [known[age] for age in sorted(known, reverse=True)[:GENERATIONS]]


@dataclass(frozen=True, slots=True)
class StateFormat(Generic[S]):
    """How the state of a kind of node is written and read: msgpack of a struct.

    A field that is added with a default needs no new version: older states decode with it. Any
    other change does. States of another version are not read.

    Attributes:
        kind: the struct.
        version: of its shape, from 1.
        objection: says in words why a state that decodes makes no sense; "" if it does.
    """

    kind: type[S]
    version: int = 1
    objection: Callable[[S], str] = lambda _state: ""

    def __post_init__(self) -> None:
        """Read the struct's annotations now, and not in each process that restores a state."""
        msgspec.msgpack.Decoder(self.kind)

    def encode(self, state: S) -> bytes:
        """Return a state as bytes."""
        return msgspec.msgpack.encode(state)

    def decode(self, version: int, data: bytes) -> S:
        """Return the state that bytes of a version stand for.

        Raises:
            StateError: another version, or the bytes do not decode, or the state makes no sense.
        """
        if version != self.version:
            raise StateError(f"version {version}, expected {self.version}")
        try:
            state = msgspec.msgpack.decode(data, type=self.kind)
            objection = self.objection(state)
        except Exception as error:  # an objection met what it was not written for
            raise StateError(f"not a {self.kind.__name__}: {in_words(error)}") from None
        if objection:
            raise StateError(f"a {self.kind.__name__} that makes no sense: {objection}")
        return state


class Keeper:
    """Keeps and finds an actor's state; whatever goes wrong is reported and never raised.

    Args:
        store: where.
        report: takes one line for the operator.
        now: simulated time.
        expected: a process came before this one, so a state should be there.
    """

    def __init__(self, store: CheckpointStore, report: Callable[[str], None],
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
        self._retry_at_s = -float("inf")
        self._pause_s = RETRY_S[0]
        self._superseded = False

    def kept(self, form: StateFormat[S]) -> S | None:
        """Return the newest state that is sound, or None: then the node has to start idle."""
        if isinstance(self._store, NoCheckpoints):
            return None
        self._began_s = self._now()
        try:
            return self._find(form)
        except Exception as error:  # of whatever a disk may hold; nothing of it ends a node
            self._superseded = isinstance(error, SupersededError)
            self._report(f"{in_words(error)}; starting without a checkpoint")
            return None

    def _find(self, form: StateFormat[S]) -> S | None:
        records, damage = self._store.load()
        if records and records[0].failures >= FAILED_IN_A_ROW:
            self._report(f"{records[0].failures} processes in a row have failed with the state "
                         "kept; starting without it")
            return None
        problems, state = list(damage), None
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
        """Keep a state, if it is another one than was kept last."""
        if self._superseded or isinstance(self._store, NoCheckpoints):
            return
        newest = form.version, form.encode(state)
        if (self._is_kept and newest == self._newest) or self._now() < self._retry_at_s:
            return
        if self._failures and self._now() - self._began_s > SOON_S:
            self._failures = 0
        try:
            self._save(newest)
        except Exception as error:
            self._is_kept = False
            self._retry_at_s = self._now() + self._pause_s
            self._pause_s = min(2 * self._pause_s, RETRY_S[1])
            self._tell(f"{in_words(error)}; going on without checkpoints")
            return
        self._pause_s = RETRY_S[0]
        trouble = self._store.trouble()
        if trouble:
            self._tell(trouble)
        elif self._problem:
            self._problem = ""
            self._report("checkpoints are kept again")

    def failed(self) -> None:
        """Note that this process ends by a failure of its own."""
        if self._newest is None or self._superseded:
            return
        soon = self._now() - self._began_s <= SOON_S
        self._failures = self._failures + 1 if soon else 0
        try:
            self._save(self._newest)
        except Exception as error:
            self._tell(in_words(error))

    def close(self) -> None:
        """Close the store."""
        self._store.close()

    def _save(self, newest: tuple[int, bytes]) -> None:
        version, data = newest
        if len(data) > LARGEST_STATE_BYTES:
            raise CheckpointError(f"a state of {len(data)} bytes, at most {LARGEST_STATE_BYTES} "
                                  "are kept")
        self._store.save(version, self._failures, data)
        self._newest, self._is_kept = newest, True

    def _tell(self, problem: str) -> None:
        if problem != self._problem:
            self._problem = problem
            self._report(problem)


def in_words(error: Exception) -> str:
    """Return an error as one short line; it may quote what it met."""
    text = " ".join(str(error).split())
    if not isinstance(error, CheckpointError):
        text = f"{type(error).__name__}: {text}"
    return "".join(c if c.isprintable() else "?" for c in text)[:200]
