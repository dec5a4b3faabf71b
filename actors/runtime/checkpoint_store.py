"""Checkpoints on stable storage: the states of one node in one SQLite file of its own.

*Atomic.* A save is one statement, and so one transaction; it takes one of a few slots in turn, so
that the generations before it stay. A process that dies in the middle of it, at whichever
instruction, leaves a log whose tail the next one ignores.

*Durable.* With a write-ahead log a commit is a write to a file: when `save` returns, the kernel
has it, and no death of the process can take it back. That the disk has it as well is seen to by a
thread, which syncs the log every `sync_period_s`: loss of power costs at most that and one sync.
So the loop of a node never waits for the disk. For the same reason the log is copied into the
database by that thread and not by whoever commits (`wal_autocheckpoint` 0): while commits go on,
until nothing is left. Then the log is cut to nothing, which needs the lock but no sync, and the
thread itself writes the first entry of the new one, because SQLite would have a node's save sync
it. (It is synced without the lock. A loss of power before that finds the old log or none: a file
that was cut to nothing is not written over in place.) A save that falls into the moment of the cut,
once in `log_limit_bytes`, waits for it: 15 to 25 ms were measured.

*Checked.* Each record has a SHA-256 over all that is in it. A CRC would find the same accidents;
this costs two microseconds and leaves no rate of missed ones to argue about. A file that SQLite
finds damaged is set aside, and what could still be read of it is used.

*Claimed.* Whoever loads claims the file for its incarnation, and every save asks, in the same
transaction, whether the claim still stands: an older process that lives on is refused. What can be
read is used even if the claim fails, for a lock or a full disk; then the first save claims, and
its generation follows all that the older process has written by then.

Assumed: the directory is on a local file system (SQLite's locks and shared log index do not work
over most network ones), and the disk keeps what it has acknowledged to have synced.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import sqlite3
import struct
import threading
from pathlib import Path
from typing import Any

from actors.runtime.checkpoint import (
    GENERATIONS,
    BusyError,
    CheckpointError,
    Loaded,
    Record,
    SupersededError,
)

STORE_FORMAT = 1
"""Version of the tables, in the file's `user_version`."""

APPLICATION = 0x52504350
"""`application_id` of the files ("RPCP")."""

LOCK_PATIENCE_S = 0.1
"""A save waits at most so long for a lock that somebody else holds."""

_COPIES = 3
"""So often the log is copied, in the hope that no save has come meanwhile, before it is cut."""

_FAR = 8
"""At so many times its limit the log is cut whatever comes."""

_DAMAGED = frozenset({sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB})

_LOCKED = frozenset({sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED})

_PAGE_BYTES = 1024
"""A save writes the pages that it touches, whole; states are some hundreds of bytes long."""

_TABLES = (
    "CREATE TABLE checkpoint (slot INTEGER PRIMARY KEY, generation INTEGER NOT NULL,"
    " incarnation INTEGER NOT NULL, version INTEGER NOT NULL, state BLOB NOT NULL,"
    " checksum BLOB NOT NULL)",
    "CREATE TABLE owner (id INTEGER PRIMARY KEY CHECK (id = 0), run TEXT NOT NULL,"
    " incarnation INTEGER NOT NULL, failures INTEGER NOT NULL, cuts INTEGER NOT NULL)",
    f"PRAGMA application_id = {APPLICATION}",
    f"PRAGMA user_version = {STORE_FORMAT}",
)

_SAVE = ("REPLACE INTO checkpoint (slot, generation, incarnation, version, state, checksum)"
         " SELECT ?, ?, ?, ?, ?, ? WHERE EXISTS"
         " (SELECT 1 FROM owner WHERE run = ? AND incarnation = ?)")


class SqliteCheckpoints:
    """The `CheckpointStore` of one node.

    Args:
        file: the node's; it and its directory are made when they are needed.
        run: name of the run; states of another run are not this one's, and are forgotten.
        incarnation: which life of the node this is.
        sync_period_s: seconds between syncs; what a loss of power can cost. 0 has no thread.
        log_limit_bytes: size of the log at which it is copied into the database and cut.
    """

    def __init__(self, file: Path, run: str, incarnation: int, *, sync_period_s: float = 0.5,
                 log_limit_bytes: int = 4 << 20) -> None:
        self._file = file
        self._run = run
        self._incarnation = incarnation
        self._period_s = sync_period_s
        self._log_limit = log_limit_bytes
        self._connection: sqlite3.Connection | None = None
        self._inode = 0
        self._generation = 0
        self._unsynced = False
        self._listed = False
        self._trouble = ""
        self._ending = threading.Event()
        self._thread: threading.Thread | None = None

    # -- the protocol ---------------------------------------------------------------------------

    def load(self) -> Loaded:
        """Return what was kept, and claim the file if that is possible; see `CheckpointStore`."""
        loaded, _ = self._load_and_claim()
        return loaded

    def save(self, version: int, state: bytes) -> None:
        """Keep a state; see `CheckpointStore`."""
        self._check_place()
        try:
            self._ready()
            saved = self._insert(version, state)
        except sqlite3.Error as error:
            if not _is_damage(error):
                raise self._error(error) from None
            self._trouble = self._set_aside(error) + "; begun anew"
            self._begin_anew()
            try:
                saved = self._insert(version, state)
            except sqlite3.Error as second:
                raise self._error(second) from None
        if not saved:
            raise self._superseded()
        self._unsynced = True
        if self._thread is None and self._period_s > 0:
            self._thread = threading.Thread(target=self._keep_synced, daemon=True,
                                            name=f"checkpoints {self._file.stem}")
            self._thread.start()

    def note_failures(self, failures: int) -> None:
        """Keep how many lives in a row have failed."""
        try:
            self._ready().execute(
                "UPDATE owner SET failures = ? WHERE run = ? AND incarnation = ?",
                (failures, self._run, self._incarnation))
        except sqlite3.Error as error:
            raise self._error(error) from None

    def trouble(self) -> str:
        """Return what the syncing thread could not do, or that a damaged file was set aside."""
        trouble, self._trouble = self._trouble, ""
        return trouble

    def close(self) -> None:
        """End the thread and close the file."""
        self._ending.set()
        if self._thread is not None:
            self._thread.join(2.0)
            self._thread = None
        self._close_connection()

    def sync(self) -> None:
        """Have the disk hold what was saved so far; the thread calls it.

        Raises:
            OSError: it does not.
            sqlite3.Error: the log could not be copied into the database.
        """
        self._unsynced = False
        log = self._beside("-wal")
        _sync_to_disk(log)
        if not self._listed:
            # The database by way of SQLite: to close a descriptor of it would drop SQLite's locks.
            self._cut_log()
            _sync_to_disk(self._file.parent)
            self._listed = True
        elif log.stat().st_size > self._log_limit:
            self._cut_log()

    # -- opening --------------------------------------------------------------------------------

    def _ready(self) -> sqlite3.Connection:
        """Return the connection, opened and claimed for this incarnation if it was not."""
        if self._connection is None:
            loaded, unclaimed = self._load_and_claim()
            if unclaimed:
                raise unclaimed
            if loaded.problems:
                self._trouble = "; ".join(loaded.problems)
        assert self._connection is not None  # noqa: S101 for the type checker
        return self._connection

    def _load_and_claim(self) -> tuple[Loaded, CheckpointError | None]:
        """Return what was kept, and why the file could not be claimed; then it is not open."""
        problems: list[str] = []
        records: list[Record] = []
        failures = 0
        was_read = False
        unclaimed: CheckpointError | None = None
        try:
            self._open()
            owner = self._owner()
            if owner is not None and owner[0] == self._run:
                if owner[1] > self._incarnation:
                    raise self._superseded()
                failures = owner[2]
                records, problems = self._read()
            was_read = True
            self._claim()
        except sqlite3.Error as error:
            if _is_damage(error):
                problems.append(self._set_aside(error))
                self._begin_anew()
            else:
                self._close_connection()
                unclaimed = self._error(error)
                if not was_read:
                    raise unclaimed from None
        records.sort(key=lambda record: -record.generation)
        self._generation = max((record.generation for record in records), default=0)
        return Loaded(tuple(records), tuple(problems), failures), unclaimed

    def _open(self) -> None:
        if self._connection is not None:
            return
        try:
            self._file.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise CheckpointError(f"{self._file.parent}: {error.strerror}") from None
        self._connection = connection = self._connect()
        (form,) = connection.execute("PRAGMA user_version").fetchone()
        (application,) = connection.execute("PRAGMA application_id").fetchone()
        if (form, application) == (0, 0) and not self._tables():
            connection.execute("PRAGMA synchronous = OFF")  # nothing in it that could be lost yet
            connection.execute(f"PRAGMA page_size = {_PAGE_BYTES}")
            connection.execute("PRAGMA journal_mode = WAL")
            with _transaction(connection):
                for statement in _TABLES:
                    connection.execute(statement)
            connection.execute("PRAGMA synchronous = NORMAL")
        elif application != APPLICATION or form > STORE_FORMAT:
            self._close_connection()
            what = "no checkpoints of a node" if application != APPLICATION else (
                f"format {form} is newer than this program's {STORE_FORMAT}")
            raise CheckpointError(f"{self._file}: {what}; the file is left as it is")
        self._inode = self._file.stat().st_ino

    def _connect(self) -> sqlite3.Connection:
        try:
            connection = sqlite3.connect(
                self._file, timeout=LOCK_PATIENCE_S, isolation_level=None,
                check_same_thread=False)
        except sqlite3.Error as error:
            raise self._error(error) from None
        try:
            connection.execute("PRAGMA wal_autocheckpoint = 0")
            connection.execute("PRAGMA synchronous = NORMAL")
        except sqlite3.Error:
            connection.close()
            raise
        return connection

    def _tables(self) -> int:
        assert self._connection is not None  # noqa: S101
        (count,) = self._connection.execute("SELECT count(*) FROM sqlite_schema").fetchone()
        return int(count)

    def _check_place(self) -> None:
        """Notice that the file was taken away: SQLite would go on writing into nowhere."""
        if self._connection is None:
            return
        try:
            same = self._file.stat().st_ino == self._inode
        except OSError:
            same = False
        if not same:
            self._close_connection()
            self._trouble = f"{self._file} has vanished; begun anew"

    def _close_connection(self) -> None:
        if self._connection is not None:
            connection, self._connection = self._connection, None
            with contextlib.suppress(sqlite3.Error):
                connection.close()

    # -- reading and writing --------------------------------------------------------------------

    def _owner(self) -> tuple[str, int, int] | None:
        assert self._connection is not None  # noqa: S101
        row = self._connection.execute("SELECT run, incarnation, failures FROM owner").fetchone()
        return row and (str(row[0]), int(row[1]), int(row[2]))

    def _claim(self) -> None:
        """Claim the file; the failures noted in it stay, the states of another run do not."""
        assert self._connection is not None  # noqa: S101
        failures = 0
        with _transaction(self._connection) as connection:
            owner = self._owner()
            if owner is None or owner[0] != self._run:
                connection.execute("DELETE FROM checkpoint")
            elif owner[1] > self._incarnation:
                raise self._superseded()
            else:
                failures = owner[2]
            connection.execute("REPLACE INTO owner VALUES (0, ?, ?, ?, 0)",
                               (self._run, self._incarnation, failures))

    def _read(self) -> tuple[list[Record], list[str]]:
        """Return the sound records and what is wrong with others; each is read by itself."""
        assert self._connection is not None  # noqa: S101
        records, problems = [], []
        for slot in range(GENERATIONS):
            try:
                row = self._connection.execute(
                    "SELECT generation, incarnation, version, state, checksum FROM checkpoint"
                    " WHERE slot = ?", (slot,)).fetchone()
            except sqlite3.Error as error:
                if not _is_damage(error):
                    raise
                problems.append(f"{self._file}: slot {slot}: {error}")
                continue
            if row is None:
                continue
            if not _is_sound(row):
                problems.append(f"{self._file}: generation {row[0]}: its checksum is wrong")
                continue
            records.append(Record(*row[:4]))
        return records, problems

    def _insert(self, version: int, state: bytes) -> bool:
        generation = self._generation + 1
        cursor = self._ready().execute(_SAVE, (
            generation % GENERATIONS, generation, self._incarnation, version, state,
            _checksum(generation, self._incarnation, version, state), self._run,
            self._incarnation))
        if cursor.rowcount != 1:
            return False
        self._generation = generation
        return True

    # -- damage ---------------------------------------------------------------------------------

    def _set_aside(self, error: sqlite3.Error) -> str:
        """Move a damaged file out of the way and return a line about it."""
        self._close_connection()
        aside = self._file.with_suffix(".damaged")
        try:
            self._file.replace(aside)
            for suffix in ("-wal", "-shm"):
                self._beside(suffix).unlink(missing_ok=True)
        except OSError as second:
            raise CheckpointError(f"{self._file}: {error}, and cannot be set aside: "
                                  f"{second.strerror}") from None
        return f"{self._file}: {error}; kept as {aside.name}"

    def _begin_anew(self) -> None:
        try:
            self._open()
            self._claim()
        except sqlite3.Error as error:
            self._close_connection()
            raise self._error(error) from None

    def _beside(self, suffix: str) -> Path:
        return self._file.with_name(self._file.name + suffix)

    def _error(self, error: sqlite3.Error) -> CheckpointError:
        kind = BusyError if _code(error) in _LOCKED else CheckpointError
        return kind(f"{self._file}: {' '.join(str(error).split())}")

    def _superseded(self) -> SupersededError:
        return SupersededError(f"{self._file}: incarnation {self._incarnation} was superseded")

    # -- the thread -----------------------------------------------------------------------------

    def _keep_synced(self) -> None:
        while not self._ending.wait(self._period_s):
            if self._unsynced:
                try:
                    self.sync()
                except (OSError, sqlite3.Error) as error:
                    self._trouble = f"{self._file}: not synced to the disk: {error}"

    def _cut_log(self) -> None:
        log = self._beside("-wal")
        connection = self._connect()
        try:
            for _ in range(_COPIES):  # syncs, while saves go on
                _, entries, copied = connection.execute("PRAGMA wal_checkpoint(PASSIVE)").fetchone()
                if entries == copied:
                    break
            else:
                if log.stat().st_size < _FAR * self._log_limit:
                    return  # a busy moment; there will be others
            connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
            connection.execute("PRAGMA synchronous = OFF")  # the lock is not held during the sync
            connection.execute("UPDATE owner SET cuts = cuts + 1")
        finally:
            connection.close()
        _sync_to_disk(log)


class _transaction:  # noqa: N801 used as a statement
    """`with` block that commits at its end or changes nothing."""

    def __init__(self, connection: sqlite3.Connection) -> None:
        self._connection = connection

    def __enter__(self) -> sqlite3.Connection:
        self._connection.execute("BEGIN IMMEDIATE")
        return self._connection

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            try:
                self._connection.execute("COMMIT")
                return
            except sqlite3.Error:
                self._undo()
                raise
        self._undo()

    def _undo(self) -> None:
        if self._connection.in_transaction:
            with contextlib.suppress(sqlite3.Error):
                self._connection.execute("ROLLBACK")


def _sync_to_disk(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _checksum(generation: int, incarnation: int, version: int, state: bytes) -> bytes:
    numbers = struct.pack(">qqq", generation, incarnation, version)
    return hashlib.sha256(numbers + state).digest()


def _is_sound(row: tuple[Any, ...]) -> bool:
    """Tell whether a row of the table is what was written; its types may be wrong as well."""
    generation, incarnation, version, state, checksum = row
    if not (isinstance(state, bytes) and all(
            isinstance(number, int) for number in (generation, incarnation, version))):
        return False
    return bool(_checksum(generation, incarnation, version, state) == checksum)


def _is_damage(error: sqlite3.Error) -> bool:
    return _code(error) in _DAMAGED


def _code(error: sqlite3.Error) -> int:
    """Return SQLite's primary result code; 0 for an error of the Python module's own."""
    return getattr(error, "sqlite_errorcode", 0) & 0xFF
