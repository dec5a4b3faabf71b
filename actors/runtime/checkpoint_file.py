"""What lies where a node's checkpoints should lie: read without believing any of it.

A disk can return anything: flipped bits, half a file, another program's file, a FIFO. So nothing
is opened before `inspect` has seen that this can neither block nor fill the memory; no table is
read before its definition has been found to be, to the letter, the one that is written here (so no
view and no trigger ever runs); no row is believed without its SHA-256, and SQLite looks through all
pages before anything is written into them. Each check raises, whatever it likes, and `read` is the
one place where that is caught: what is unsound is named, what is sound is returned.

`is_damage` tells an error that lies with the file, which then is set aside, from one that lies with
the disk or the machine, which would meet a new file as well.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import sqlite3
import stat
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

from rampart.actors.runtime.checkpoint import GENERATIONS, Record

STORE_FORMAT = 2
"""Version of the tables and checksums, in the file's `user_version`."""

APPLICATION = 0x52504350
"""`application_id` of the files ("RPCP")."""

LOCK_PATIENCE_S = 0.1
"""A statement waits at most so long for a lock that another process holds."""

LARGEST_STATE_BYTES = 2 << 20
"""A thousand times what states are. More is neither kept nor read."""

LARGEST_FILE_BYTES = 256 << 20
"""Some hundreds of times what the four generations and their log come to. More is not opened."""

SUFFIXES = ("", "-wal", "-shm", "-journal")
"""What SQLite opens, or replays, beside a database."""

_MOST_STEPS = 100_000
"""A statement of SQLite's machine may take so many steps: reading takes some hundreds, loading
another schema, or a view, may take minutes."""

_MOST_ASIDE = 9
_PAGE_BYTES = 1024
"""A save writes the pages that it touches, whole; states are some hundreds of bytes long."""

_TABLES = {
    b"checkpoint": (
        b"CREATE TABLE checkpoint (slot INTEGER PRIMARY KEY, generation INTEGER NOT NULL,"
        b" incarnation INTEGER NOT NULL, version INTEGER NOT NULL, state BLOB NOT NULL,"
        b" checksum BLOB NOT NULL)"),
    b"owner": (
        b"CREATE TABLE owner (id INTEGER PRIMARY KEY CHECK (id = 0), run TEXT NOT NULL,"
        b" incarnation INTEGER NOT NULL, failures INTEGER NOT NULL, checksum BLOB NOT NULL)"),
}

_THE_MACHINES = frozenset({
    sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED, sqlite3.SQLITE_NOMEM, sqlite3.SQLITE_FULL,
    sqlite3.SQLITE_IOERR, sqlite3.SQLITE_PROTOCOL})
_PERHAPS_THE_FILES = frozenset({
    sqlite3.SQLITE_READONLY, sqlite3.SQLITE_CANTOPEN, sqlite3.SQLITE_PERM})

T = TypeVar("T")


class Unsound(Exception):  # noqa: N818 a finding
    """What lies there is not what was written; the text says what is wrong."""


@dataclass(frozen=True, slots=True)
class Owner:
    """Whose states these are: run, claiming incarnation, how many processes in a row failed."""

    run: str
    incarnation: int
    failures: int


@dataclass(slots=True)
class Found:
    """What was found sound, newest record first, and what was not, in words."""

    owner: Owner | None = None
    records: list[Record] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)

    @property
    def incarnation(self) -> int:
        """The one that has claimed it, as far as that is known."""
        return self.owner.incarnation if self.owner else max(
            (record.incarnation for record in self.records), default=0)

    @property
    def failures(self) -> int:
        """How many processes in a row failed."""
        return self.owner.failures if self.owner else 0


# -- before anything is opened -------------------------------------------------------------------


def beside(file: Path, suffix: str) -> Path:
    """Return the path of what SQLite keeps beside a database."""
    return file.with_name(file.name + suffix)


def inspect(file: Path) -> None:
    """Make sure that opening a file, and what lies beside it, can neither block nor take for ever.

    Raises:
        Unsound: it is no regular file, too large, or another user's.
        OSError: that cannot be found out.
    """
    users = users_of(file.parent)
    for path in (beside(file, suffix) for suffix in SUFFIXES):
        try:
            found = path.lstat()
        except FileNotFoundError:
            continue
        if not stat.S_ISREG(found.st_mode):
            raise Unsound(f"{path.name} is no regular file ({stat.filemode(found.st_mode)})")
        if found.st_uid not in users:
            raise Unsound(f"{path.name} belongs to user {found.st_uid}")
        if found.st_size > LARGEST_FILE_BYTES:
            raise Unsound(f"{path.name} has {found.st_size} bytes")


def users_of(directory: Path) -> set[int]:
    """Return whose files may lie in a directory: ours, and those of its owner.

    He can replace any file in it, and some file systems give all files one owner.
    """
    return {os.geteuid(), directory.stat().st_uid}


def set_aside(file: Path) -> str:
    """Move a file and what lies beside it out of the way, and return its new name.

    Raises:
        OSError: it cannot be moved.
    """
    aside = _free_name(file)
    for suffix in SUFFIXES:
        path = beside(file, suffix)
        if os.path.lexists(path):
            path.replace(beside(aside, suffix))
    return aside.name


def _free_name(file: Path) -> Path:
    """Return where to; an earlier one is written over, unless there are directories in the way."""
    for number in range(1, _MOST_ASIDE + 1):
        aside = file.with_suffix(".damaged" if number == 1 else f".damaged{number}")
        pairs = ((beside(file, suffix), beside(aside, suffix)) for suffix in SUFFIXES)
        if not any(os.path.lexists(new) and (new.is_dir() or old.is_dir()) for old, new in pairs):
            return aside
    raise FileExistsError(17, f"{file.with_suffix('.damaged').name} and others are in the way")


# -- opening -------------------------------------------------------------------------------------


def connect(file: Path) -> sqlite3.Connection:
    """Return a connection on which no statement takes for ever and no value fills the memory."""
    connection = sqlite3.connect(
        file, timeout=LOCK_PATIENCE_S, isolation_level=None, check_same_thread=False)
    try:
        connection.text_factory = bytes
        connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, 2 * LARGEST_STATE_BYTES)
        connection.set_progress_handler(lambda: 1, _MOST_STEPS)
        connection.execute("PRAGMA trusted_schema = OFF")
        connection.execute("PRAGMA wal_autocheckpoint = 0")
        connection.execute("PRAGMA synchronous = NORMAL")
    except BaseException:
        connection.close()
        raise
    return connection


def is_new(connection: sqlite3.Connection) -> bool:
    """Whether there is nothing at all: the node is about to make the tables."""
    return not (_pragma(connection, "user_version") or _pragma(connection, "application_id")
                or _schema(connection))


def make_tables(connection: sqlite3.Connection) -> None:
    """Make the tables, if there is nothing at all."""
    if not is_new(connection):
        return
    connection.execute("PRAGMA synchronous = OFF")  # nothing in it that could be lost yet
    connection.execute(f"PRAGMA page_size = {_PAGE_BYTES}")
    connection.execute("PRAGMA journal_mode = WAL")
    with transaction(connection):
        for table in _TABLES.values():
            connection.execute(table.decode())
        connection.execute(f"PRAGMA application_id = {APPLICATION}")
        connection.execute(f"PRAGMA user_version = {STORE_FORMAT}")
    connection.execute("PRAGMA synchronous = NORMAL")


@contextlib.contextmanager
def transaction(connection: sqlite3.Connection) -> Iterator[sqlite3.Connection]:
    """Commit at the end of a `with` block, or change nothing."""
    connection.execute("BEGIN IMMEDIATE")
    try:
        yield connection
        connection.execute("COMMIT")
    finally:
        if connection.in_transaction:
            with contextlib.suppress(sqlite3.Error):
                connection.execute("ROLLBACK")


# -- reading -------------------------------------------------------------------------------------


def read(connection: sqlite3.Connection, file: Path, run: str) -> Found:
    """Return what is sound of a run's, and what is wrong with the rest.

    Of another run's file nothing is returned but what is wrong with it.

    Raises:
        Exception: nothing can be read; `is_damage` tells whether that lies with the file.
    """
    found = Found()

    def sound(what: str, check: Callable[..., T], *arguments: object) -> T | None:
        try:
            return check(connection, *arguments)
        except Exception as error:
            if not is_damage(error, file):
                raise
            found.problems.append(f"{what}: {words(error)}")
            return None

    if _schema(connection) != _TABLES:
        raise Unsound("its tables are not those of checkpoints")
    sound("header", _check_header)
    sound("pages", _check_pages)
    owner = sound("owner", read_owner)
    records = [sound(f"slot {slot}", _read_record, slot, owner.run if owner else run)
               for slot in range(GENERATIONS)]
    sound("rows", _check_rows)
    if owner is None or owner.run == run:
        found.owner = owner
        found.records = sorted((record for record in records if record is not None),
                               key=lambda record: -record.generation)
    return found


def read_owner(connection: sqlite3.Connection) -> Owner | None:
    """Return the owner that has claimed the file, None if there is none.

    Raises:
        Unsound: the row is not what was written.
        sqlite3.Error: it cannot be read.
    """
    row = connection.execute("SELECT run, incarnation, failures, checksum FROM owner").fetchone()
    if row is None:
        return None
    run, incarnation, failures, checksum = row
    if not (isinstance(run, bytes) and isinstance(incarnation, int) and isinstance(failures, int)):
        raise Unsound("values of a wrong type")
    owner = Owner(run.decode(errors="replace"), incarnation, failures)
    if checksum != owner_checksum(owner):
        raise Unsound("its checksum is wrong")
    return owner


def _read_record(connection: sqlite3.Connection, slot: int, run: str) -> Record | None:
    row = connection.execute("SELECT generation, incarnation, version, state, checksum"
                             " FROM checkpoint WHERE slot = ?", (slot,)).fetchone()
    if row is None:
        return None
    generation, incarnation, version, state, checksum = row
    numbers = (generation, incarnation, version)
    if not (isinstance(state, bytes) and all(isinstance(number, int) for number in numbers)):
        raise Unsound("values of a wrong type")
    record = Record(generation, incarnation, version, state)
    if checksum != record_checksum(run, record) or generation % GENERATIONS != slot:
        raise Unsound(f"generation {generation}: its checksum is wrong")
    return record


def _check_header(connection: sqlite3.Connection) -> None:
    if _pragma(connection, "application_id") != APPLICATION:
        raise Unsound("no checkpoints of a node")
    if (form := _pragma(connection, "user_version")) != STORE_FORMAT:
        raise Unsound(f"format {form}; this program's is {STORE_FORMAT}")
    if _pragma(connection, "journal_mode") != b"wal":
        raise Unsound("no write-ahead log")


def _check_pages(connection: sqlite3.Connection) -> None:
    if (answer := _pragma(connection, "quick_check(1)")) != b"ok":
        raise Unsound(words(answer))


def _check_rows(connection: sqlite3.Connection) -> None:
    """Make sure that there is no row but those that were looked for."""
    rows, known, owners = connection.execute(
        "SELECT count(*), coalesce(sum(slot >= 0 AND slot < ?), 0), (SELECT count(*) FROM owner)"
        " FROM checkpoint", (GENERATIONS,)).fetchone()
    if rows != known:
        raise Unsound("one is out of its place")
    if rows and not owners:
        raise Unsound("that of the owner is missing")


def _schema(connection: sqlite3.Connection) -> dict[object, object]:
    """Return the definitions of all tables, views and triggers by name."""
    return dict(connection.execute("SELECT name, sql FROM sqlite_schema LIMIT 9").fetchall())


def _pragma(connection: sqlite3.Connection, name: str) -> object:
    return connection.execute(f"PRAGMA {name}").fetchone()[0]


# -- checksums and errors ------------------------------------------------------------------------


def record_checksum(run: str, record: Record) -> bytes:
    """Return what is written beside a record: over all of it, and the run that it is of."""
    return _digest("record", run, record.generation, record.incarnation, record.version,
                   state=record.state)


def owner_checksum(owner: Owner) -> bytes:
    """Return what is written beside the owner."""
    return _digest("owner", owner.run, owner.incarnation, owner.failures)


def _digest(kind: str, run: str, *numbers: int, state: bytes = b"") -> bytes:
    head = f"{kind} {STORE_FORMAT} {run}\0".encode(errors="replace")
    return hashlib.sha256(head + struct.pack(f">{len(numbers)}q", *numbers) + state).digest()


def is_damage(error: Exception, file: Path) -> bool:
    """Tell whether an error lies with a file, so that a new one in its place would be without it.

    It does unless it is known to lie with the disk or the machine: what a damaged file can make
    of SQLite, and SQLite of Python, has no end.
    """
    if isinstance(error, (OSError, MemoryError)):
        return False
    code = primary_code(error)
    if code in _PERHAPS_THE_FILES:  # also said of a full table of descriptors
        paths = (beside(file, suffix) for suffix in SUFFIXES)
        refused = any(os.path.lexists(path) and not os.access(path, os.R_OK | os.W_OK)
                      for path in paths)
        replaceable = os.access(file.parent, os.W_OK | os.X_OK)
        return replaceable and (refused or code != sqlite3.SQLITE_CANTOPEN)
    return code not in _THE_MACHINES


def primary_code(error: Exception) -> int:
    """Return SQLite's primary result code; 0 for an error that is not SQLite's."""
    return getattr(error, "sqlite_errorcode", 0) & 0xFF


def words(error: object) -> str:
    """Return an error as one short line; it may quote what it met."""
    text = error.decode(errors="replace") if isinstance(error, bytes) else str(error)
    if isinstance(error, Exception) and not isinstance(error, (Unsound, sqlite3.Error, OSError)):
        text = f"{type(error).__name__}: {text}"
    return "".join(c if c.isprintable() else "?" for c in " ".join(text.split()))[:200]
