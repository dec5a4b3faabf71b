"""Checkpoints on stable storage: the states of one node in one SQLite file of its own.

*Atomic.* A save is one statement, and so one transaction; it takes one of a few slots in turn, so
that the generations before it stay. A process that dies in the middle of it, at whichever
instruction, leaves a log whose tail the next one ignores.

*Durable.* With a write-ahead log a commit is a write to a file: when `save` returns, the kernel
has it, and no death of the process can take it back. That the disk has it as well is seen to by a
thread, which syncs the log every `sync_period_s`: loss of power costs at most that and one sync.
So the loop of a node never waits for the disk. For the same reason the log is copied into the
database by that thread, not by the one that commits (`wal_autocheckpoint` 0): while commits go on,
until nothing is left. Then the log is cut to nothing, which needs the lock but no sync, and the
thread itself writes the first entry of the new one, because SQLite would have a node's save sync
it. (It is synced without the lock. A loss of power before that finds the old log or none: a file
that was cut to nothing is not written over in place.) A save that falls into the moment of the cut,
once in `log_limit_bytes`, waits for it: 15 to 25 ms were measured.

*Checked.* Whatever lies there is read by `checkpoint_file`, which believes nothing. If any of it is
damaged, the file is set aside and begun anew with what is sound of it: a file is either whole or
replaced, and there is no kind of damage that is dealt with in a way of its own.

*Claimed.* A process that loads claims the file for its incarnation, and every save asks, in the
same transaction, whether the claim still stands: an older process is refused, should it still run.
What can be read is used even if the claim fails, for a lock or a full disk; then the first save
claims, and its generation follows all that the older process has written by then.

Assumed: the directory is on a local file system (SQLite's locks and shared log index do not work
over most network ones), and the disk keeps what it has acknowledged to have synced.
"""

from __future__ import annotations

import contextlib
import os
import sqlite3
import threading
from pathlib import Path

from rampart.actors.runtime import checkpoint_file as disk
from rampart.actors.runtime.checkpoint import (
    GENERATIONS,
    BusyError,
    CheckpointError,
    CheckpointStore,
    Loaded,
    Record,
    SupersededError,
)

_COPIES = 3
"""So often the log is copied, in the hope that no save has come meanwhile, before it is cut."""

_FAR = 8
"""At so many times its limit the log is cut whatever comes."""

LOCKED = frozenset({sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED})

_PUT = ("REPLACE INTO checkpoint (slot, generation, incarnation, version, state, checksum)"
        " SELECT ?, ?, ?, ?, ?, ? WHERE EXISTS"
        " (SELECT 1 FROM owner WHERE run = ? AND incarnation = ?)")


class SqliteCheckpoints(CheckpointStore):
    """The `CheckpointStore` of one node.

    Args:
        file: the node's; it and its directory are made when they are needed.
        run: name of the run; states of another run are not this one's, and are forgotten.
        incarnation: which process of the node this is.
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
        return self._load_and_claim()[0]

    def save(self, version: int, state: bytes) -> None:
        """Keep a state; see `CheckpointStore`."""
        if len(state) > disk.LARGEST_STATE_BYTES:
            raise CheckpointError(f"{self._file}: a state of {len(state)} bytes is too large; "
                                  f"{disk.LARGEST_STATE_BYTES} can be kept")
        self._check_place()
        try:
            self._insert(version, state)
        except Exception as error:
            if not disk.is_damage(error, self._file):
                raise self._error(error) from None
            self._trouble = self._replace(disk.Found(problems=[disk.words(error)]))
            try:
                self._insert(version, state)
            except Exception as second:
                raise self._error(second) from None
        self._have_synced()

    def take(self, record: Record) -> bool:
        """Keep a state that a process of the node has kept on another host.

        Args:
            record: of the incarnation that this store is for, which runs there and not here.

        Returns:
            Whether it was newer than what is here; else nothing has changed.

        Raises:
            SupersededError: a newer incarnation has claimed the store.
            CheckpointError: it could not be kept; the previous states are still there.
        """
        self._check_place()
        loaded, unclaimed = self._load_and_claim()
        if unclaimed:
            raise unclaimed
        if loaded.problems:
            self._trouble = "; ".join(loaded.problems)
        if loaded.records and record.age <= loaded.records[0].age:
            return False
        try:
            with disk.transaction(self._ready()) as connection:
                # What has gone on here meanwhile was superseded: the higher generation is newer.
                connection.execute(
                    "DELETE FROM checkpoint WHERE generation >= ?", (record.generation,))
                if self._put(connection, record) != 1:
                    raise self._superseded()
        except Exception as error:
            raise self._error(error) from None
        self._generation = record.generation
        self._have_synced()
        return True

    def note_failures(self, failures: int) -> None:
        """Keep how many processes in a row have failed."""
        try:
            owner = disk.Owner(self._run, self._incarnation, failures)
            self._ready().execute(
                "UPDATE owner SET failures = ?, checksum = ? WHERE run = ? AND incarnation = ?",
                (failures, disk.owner_checksum(owner), self._run, self._incarnation))
        except Exception as error:
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
        log = disk.beside(self._file, "-wal")
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
        found = disk.Found()
        was_read = False
        problem = ""
        unclaimed: CheckpointError | None = None
        try:
            connection = self._open()
            found = disk.read(connection, self._file, self._run)
            if found.incarnation > self._incarnation:
                raise self._superseded()
            was_read = True
            if not found.problems:
                self._claim(found)
        except SupersededError:
            raise
        except Exception as error:
            if disk.is_damage(error, self._file):
                found.problems.append(disk.words(error))
            else:
                self._close_connection()
                unclaimed = self._error(error)
                if not was_read:
                    raise unclaimed from None
        if found.problems:
            try:
                problem = self._replace(found)
            except CheckpointError as error:
                unclaimed, problem = error, str(error)
        # Should the file have vanished, what follows is newer than copies of it all the same.
        self._generation = max(self._generation, *(r.generation for r in found.records), 0)
        return Loaded(tuple(found.records), (problem,) if problem else (),
                      found.failures), unclaimed

    def _open(self) -> sqlite3.Connection:
        """Return the connection to a file that has tables; what is in them is not known yet.

        Raises:
            Exception: it cannot be had, or the file is damaged.
        """
        if self._connection is None:
            try:
                self._file.parent.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise CheckpointError(f"{self._file.parent}: {error.strerror}") from None
            disk.inspect(self._file)
            self._connection = disk.connect(self._file)
            disk.make_tables(self._connection)
            self._inode = self._file.lstat().st_ino
        return self._connection

    def _check_place(self) -> None:
        """Notice that the file was taken away: SQLite would go on writing into nowhere."""
        if self._connection is None:
            return
        with contextlib.suppress(OSError):
            if self._file.lstat().st_ino == self._inode:
                return
        self._close_connection()
        self._trouble = f"{self._file} has vanished; begun anew"

    def _close_connection(self) -> None:
        if self._connection is not None:
            connection, self._connection = self._connection, None
            with contextlib.suppress(sqlite3.Error):
                connection.close()

    # -- writing --------------------------------------------------------------------------------

    def _claim(self, found: disk.Found) -> None:
        """Claim the file; the states of another run do not stay, those that were saved do."""
        assert self._connection is not None  # noqa: S101 for the type checker
        failures = found.failures
        with disk.transaction(self._connection) as connection:
            owner = disk.read_owner(connection)
            if owner is None or owner.run != self._run:
                connection.execute("DELETE FROM checkpoint")
            elif owner.incarnation > self._incarnation:
                raise self._superseded()
            else:
                failures = owner.failures
            claimed = disk.Owner(self._run, self._incarnation, failures)
            connection.execute("REPLACE INTO owner VALUES (0, ?, ?, ?, ?)", (
                self._run, self._incarnation, failures, disk.owner_checksum(claimed)))
            for record in found.records if found.problems else ():
                self._put(connection, record)

    def _insert(self, version: int, state: bytes) -> None:
        """Keep a state as the next generation.

        Raises:
            Exception: it could not be kept.
        """
        connection = self._ready()
        record = Record(self._generation + 1, self._incarnation, version, state)
        if self._put(connection, record) != 1:
            if disk.read_owner(connection) is None:
                raise disk.Unsound("owner: its row is missing")
            raise self._superseded()
        self._generation = record.generation

    def _put(self, connection: sqlite3.Connection, record: Record) -> int:
        values = (record.generation % GENERATIONS, *record,
                  disk.record_checksum(self._run, record), self._run, self._incarnation)
        return connection.execute(_PUT, values).rowcount

    # -- damage ---------------------------------------------------------------------------------

    def _replace(self, found: disk.Found) -> str:
        """Set a damaged file aside, begin anew with what is sound of it, and return a line.

        Raises:
            CheckpointError: that is not possible.
        """
        line = f"{self._file}: {'; '.join(found.problems)}"
        try:
            aside = disk.set_aside(self._file)  # before it is closed, which would change it
        except OSError as error:
            raise CheckpointError(f"{line}; it cannot be set aside: {error.strerror}") from None
        finally:
            self._close_connection()
        try:
            self._open()
            self._claim(found)
        except Exception as error:
            self._close_connection()
            raise self._error(error) from None
        return f"{line}; kept as {aside}, begun anew"

    def _error(self, error: Exception) -> CheckpointError:
        if isinstance(error, CheckpointError):
            return error
        kind = BusyError if disk.primary_code(error) in LOCKED else CheckpointError
        why = getattr(error, "strerror", None) or disk.words(error)
        return kind(f"{self._file}: {why}")

    def _superseded(self) -> SupersededError:
        return SupersededError(f"{self._file}: incarnation {self._incarnation} was superseded")

    # -- the thread -----------------------------------------------------------------------------

    def _have_synced(self) -> None:
        self._unsynced = True
        if self._thread is None and self._period_s > 0:
            self._thread = threading.Thread(target=self._keep_synced, daemon=True,
                                            name=f"checkpoints {self._file.stem}")
            self._thread.start()

    def _keep_synced(self) -> None:
        while not self._ending.wait(self._period_s):
            if self._unsynced:
                try:
                    self.sync()
                except Exception as error:  # whatever it is, the thread tries again
                    self._unsynced = True
                    self._trouble = f"{self._file}: not synced to the disk: {disk.words(error)}"

    def _cut_log(self) -> None:
        log = disk.beside(self._file, "-wal")
        with contextlib.closing(disk.connect(self._file)) as connection:
            for _ in range(_COPIES):  # syncs, while saves go on
                _, entries, copied = connection.execute("PRAGMA wal_checkpoint(PASSIVE)").fetchone()
                if entries == copied:
                    break
            else:
                if log.stat().st_size < _FAR * self._log_limit:
                    return  # a busy moment; there will be others
            connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
            connection.execute("PRAGMA synchronous = OFF")  # the lock is not held during the sync
            connection.execute("UPDATE owner SET checksum = checksum")
        _sync_to_disk(log)


def newest(file: Path, run: str) -> Record | None:
    """Return the newest sound state of a run in a node's file, whoever may be writing there.

    Raises:
        Exception: nothing can be read; whatever a damaged file makes of SQLite.
    """
    if not os.path.lexists(file):
        return None
    disk.inspect(file)
    with contextlib.closing(disk.connect(file)) as connection:
        if disk.is_new(connection):
            return None
        found = disk.read(connection, file, run)
    return found.records[0] if found.records else None


def _sync_to_disk(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
