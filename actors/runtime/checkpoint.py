"""What a node must not forget: the format of its state, and where it is kept.

A node keeps the whole of its state, never a change to it, so that any one good checkpoint is
enough. It is kept *before* the message that acts on it goes out (write-ahead): what others were
told is never newer than what is kept. `StateFormat` turns states into bytes and back, from older
versions too; a `CheckpointStore` keeps the last few generations of one node's bytes; a `Keeper`
stands between them and the actor, and sees to it that no trouble with checkpoints ever ends one.

The paper's controller has no checkpoints ("it hasn't been implemented yet", section V-B), and
`NoCheckpoints` is that controller.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Generic, NamedTuple, TypeVar

import msgspec

S = TypeVar("S", bound=msgspec.Struct)

GENERATIONS = 4
"""So many generations are kept of each node."""

FAILED_IN_A_ROW = 3
"""A state with which so many processes in a row failed, each soon after its start, is tried no
more: the node starts idle rather than in a loop of crashes."""

SOON_S = 10.0
"""A failure within so many simulated seconds of the start is put down to the state loaded."""

RETRY_S = (1.0, 30.0)
"""Simulated seconds after which a save that failed is tried again: at first, and at most. Each
attempt may cost the node's loop as long as the store waits for a lock."""

BUSY_S = 0.1
"""Simulated seconds after which a save is tried again that found the store locked."""

BUSY_TIMES = 5
"""So often in a row that is no trouble yet: the store's own thread needs the lock now and then."""


class CheckpointError(OSError):
    """A state could not be kept or found; the text is one line that names file and reason."""


class SupersededError(CheckpointError):
    """A newer incarnation of the node keeps its state; this one's is refused."""


class BusyError(CheckpointError):
    """Another process or thread holds the store's lock; perhaps not for long."""


class StateError(ValueError):
    """Bytes that are no state of this node; the text is one line that says why."""


class Record(NamedTuple):
    """One generation of a node's state, its checksum found right."""

    generation: int
    incarnation: int
    version: int
    state: bytes

    @property
    def age(self) -> tuple[int, int]:
        """By which of two states of a node the newer one is known: it is the greater."""
        return self.incarnation, self.generation


@dataclass(frozen=True, slots=True)
class Loaded:
    """What a store holds of a node.

    Attributes:
        records: sound ones, newest first.
        problems: what was found damaged, one line each.
        failures: how many processes in a row failed soon after they had loaded.
    """

    records: tuple[Record, ...] = ()
    problems: tuple[str, ...] = ()
    failures: int = 0


class CheckpointStore:
    """Keeps the states of one node, for one of its incarnations.

    This class itself keeps nothing: see `NoCheckpoints`.
    """

    def load(self) -> Loaded:
        """Return what was kept, and claim the store: older incarnations are refused from now on.

        What can be read is returned even if the store cannot be claimed; the first save claims it.

        Raises:
            SupersededError: a newer incarnation has claimed it.
            CheckpointError: it cannot be read.
        """
        return Loaded()

    def save(self, version: int, state: bytes) -> None:
        """Keep a state, whole or not at all; after the return it survives the process.

        Raises:
            SupersededError: a newer incarnation has claimed the store.
            CheckpointError: it could not be kept; the previous states are still there.
        """

    def note_failures(self, failures: int) -> None:
        """Keep how many processes in a row have failed.

        Raises:
            CheckpointError: it could not be kept.
        """

    def trouble(self) -> str:
        """Return what went wrong behind the node's back since the last call; "" if nothing."""
        return ""

    def close(self) -> None:
        """Release all that is open. Harmless when repeated."""


class NoCheckpoints(CheckpointStore):
    """Keeps nothing: a respawned node starts afresh, as in the paper."""


@dataclass(slots=True)
class Shelf:
    """What is kept of one node in virtual time: it outlives the node's virtual processes."""

    incarnation: int = 0
    records: tuple[Record, ...] = ()
    failures: int = 0


class MemoryCheckpoints(CheckpointStore):
    """Keeps states on a shelf, for virtual time and for tests."""

    def __init__(self, shelf: Shelf, incarnation: int) -> None:
        self._shelf = shelf
        self._incarnation = incarnation

    def load(self) -> Loaded:
        """Return what lies there, and claim the shelf."""
        self._check()
        self._shelf.incarnation = self._incarnation
        return Loaded(self._shelf.records, (), self._shelf.failures)

    def save(self, version: int, state: bytes) -> None:
        """Put a state on the shelf."""
        if self._incarnation != self._shelf.incarnation:
            self.load()
        records = self._shelf.records
        generation = records[0].generation + 1 if records else 1
        newest = Record(generation, self._incarnation, version, state)
        self._shelf.records = (newest, *records)[:GENERATIONS]

    def note_failures(self, failures: int) -> None:
        """Put it there as well."""
        self._check()
        self._shelf.failures = failures

    def _check(self) -> None:
        if self._incarnation < self._shelf.incarnation:
            raise SupersededError(f"incarnation {self._incarnation} was superseded by "
                                  f"{self._shelf.incarnation}")


@dataclass(frozen=True, slots=True)
class StateFormat(Generic[S]):
    """How the state of a kind of node is written and read: msgpack of a struct.

    A field that is added with a default needs no new version: older states decode with it. Any
    other change does, and an upgrade.

    Attributes:
        kind: the struct.
        version: of its shape, from 1.
        upgrades: by version, what makes a plain dictionary of that version one of the next.
        objection: says in words why a state that decodes makes no sense; "" if it does.
    """

    kind: type[S]
    version: int = 1
    upgrades: Mapping[int, Callable[[dict[str, Any]], dict[str, Any]]] = field(
        default_factory=dict)
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
            StateError: the version is newer than this program or too old for it, or the bytes do
                not decode, or the state makes no sense.
        """
        if version > self.version:
            raise StateError(f"version {version} is newer than this program's {self.version}")
        try:
            if version == self.version:
                state = msgspec.msgpack.decode(data, type=self.kind)
            else:
                state = msgspec.convert(self._upgraded(version, data), self.kind)
            objection = self.objection(state)
        except StateError:
            raise
        except Exception as error:  # an upgrade or a check met what it was not written for
            why = " ".join(str(error).split())
            raise StateError(f"no {self.kind.__name__}: {type(error).__name__}: {why}") from None
        if objection:
            raise StateError(f"a {self.kind.__name__} that makes no sense: {objection}")
        return state

    def _upgraded(self, version: int, data: bytes) -> dict[str, Any]:
        plain = msgspec.msgpack.decode(data, type=dict[str, Any])
        for step in range(version, self.version):
            if step not in self.upgrades:
                raise StateError(f"version {version} is too old for this program's {self.version}")
            plain = self.upgrades[step](plain)
        return plain


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
        self._used = False
        self._kept: bytes | None = None
        self._problem = ""
        self._retry_at_s = -float("inf")
        self._pause_s = RETRY_S[0]
        self._busy = 0
        self._superseded = False

    def kept(self, form: StateFormat[S]) -> S | None:
        """Return the newest state that is sound, or None: then the node has to start idle."""
        if isinstance(self._store, NoCheckpoints):
            return None
        self._used = True
        self._began_s = self._now()
        try:
            return self._find(form)
        except Exception as error:  # of whatever a disk may hold; nothing of it ends a node
            self._superseded = isinstance(error, SupersededError)
            self._report(f"{_in_words(error)}; starting without a checkpoint")
            return None

    def _find(self, form: StateFormat[S]) -> S | None:
        loaded = self._load()
        self._failures = loaded.failures
        if loaded.failures >= FAILED_IN_A_ROW:
            self._report(f"{loaded.failures} processes in a row have failed with the state kept; "
                         "starting without it")
            self._note(0)
            return None
        state, problems = newest_sound(form, loaded.records)
        problems = (*loaded.problems, *problems)
        if problems or (state is None and self._expected):
            start = ("starting without a checkpoint" if state is None
                     else "taking the newest sound one")
            self._report(f"{'; '.join(problems) or 'no checkpoint was found'}; {start}")
        return state

    def keep(self, form: StateFormat[S], state: S) -> None:
        """Keep a state, if it is another one than was kept last."""
        if self._superseded or isinstance(self._store, NoCheckpoints):
            return
        data = form.encode(state)
        if data == self._kept or self._now() < self._retry_at_s:
            return
        self._used = True
        try:
            self._store.save(form.version, data)
        except Exception as error:
            self._kept = None
            self._busy += 1
            if isinstance(error, BusyError) and self._busy < BUSY_TIMES:
                self._retry_at_s = self._now() + BUSY_S
                return
            self._superseded = isinstance(error, SupersededError)
            self._retry_at_s = self._now() + self._pause_s
            self._pause_s = min(2 * self._pause_s, RETRY_S[1])
            self._tell(f"{_in_words(error)}; going on without checkpoints")
            return
        self._kept = data
        self._busy = 0
        self._pause_s = RETRY_S[0]
        if self._failures and self._now() - self._began_s > SOON_S:
            self._note(0)
        trouble = self._store.trouble()
        if trouble:
            self._tell(trouble)
        elif self._problem:
            self._problem = ""
            self._report("checkpoints are kept again")

    def failed(self) -> None:
        """Note that this process ends by a failure of its own."""
        if not self._used or self._superseded:
            return
        soon = self._now() - self._began_s <= SOON_S
        self._note(self._failures + 1 if soon else 0)

    def close(self) -> None:
        """Close the store."""
        self._store.close()

    def _load(self) -> Loaded:
        """Load, again if the lock is held; each attempt waits as long as the store does."""
        for _ in range(BUSY_TIMES - 1):
            with contextlib.suppress(BusyError):
                return self._store.load()
        return self._store.load()

    def _note(self, failures: int) -> None:
        self._failures = failures
        try:
            self._store.note_failures(failures)
        except Exception as error:
            self._tell(_in_words(error))

    def _tell(self, problem: str) -> None:
        if problem != self._problem:
            self._problem = problem
            self._report(problem)


def _in_words(error: Exception) -> str:
    return str(error) if isinstance(error, CheckpointError) else f"{type(error).__name__}: {error}"


def newest_sound(form: StateFormat[S],
                 records: tuple[Record, ...]) -> tuple[S | None, tuple[str, ...]]:
    """Return the first of the records (newest first) that is a sound state, and what was not."""
    problems: list[str] = []
    for record in records:
        try:
            return form.decode(record.version, record.state), tuple(problems)
        except StateError as error:
            problems.append(f"generation {record.generation}: {error}")
    return None, tuple(problems)
