"""Store of a campaign's results: an SQLite file with each run once, sound after any crash."""

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import msgspec

from rampart.files.plain_text import shown
from rampart.sim.campaign.job import Job, RunResult

FILE_NAME = "runs.sqlite"

_SCHEMA = """
create table if not exists about (name text primary key, value text not null);
create table if not exists runs (
    key text primary key, job blob not null, result blob not null,
    finished_at text not null default current_timestamp);
"""
_FORMAT = "2"


class StoreError(ValueError):
    """The file cannot be used; the message is one line."""


class Run(NamedTuple):
    """A job and its result."""

    job: Job
    result: RunResult


class Store:
    """Results by the keys of their jobs.

    Each run is stored in a transaction, so a full disk damages no earlier run. Every method raises
    `StoreError` if the file cannot be read or written.

    Args:
        directory: Of the campaign; made if necessary.

    Raises:
        StoreError: The file is not a store, or one of another version.
    """

    def __init__(self, directory: Path) -> None:
        self.path = directory / FILE_NAME
        try:
            directory.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise StoreError(f"{directory}: no directory that can be written ({error.strerror})"
                             ) from None
        try:
            self._database = sqlite3.connect(self.path, timeout=30.0)
            self._database.execute("pragma journal_mode = wal")
            self._database.executescript(_SCHEMA)
            self._database.execute(
                "insert or ignore into about values ('format', ?)", (_FORMAT,))
            self._database.commit()
            (found,) = self._database.execute(
                "select value from about where name = 'format'").fetchone()
        except (sqlite3.Error, ValueError, TypeError) as error:
            raise StoreError(f"{self.path}: not a store of campaign results: {error}") from None
        if found != _FORMAT:
            raise StoreError(f"{self.path}: format {shown(found)}, expected {_FORMAT}; "
                             "choose another --out")

    def keys(self) -> set[str]:
        """Return the keys of all runs."""
        with self._using():
            return {key for (key,) in self._database.execute("select key from runs")}

    def add(self, job: Job, result: RunResult) -> None:
        """Store a run, unless it is there already."""
        with self._using(), self._database:
            self._database.execute(
                "insert or ignore into runs (key, job, result) values (?, ?, ?)",
                (job.key, msgspec.msgpack.encode(job), msgspec.msgpack.encode(result)))

    def find(self, key: str) -> Run | None:
        """Return the run whose key begins with a text, if there is exactly one."""
        with self._using():
            found = self._database.execute(
                "select job, result from runs where key like ? limit 2", (f"{key}%",)).fetchall()
            return _run(*found[0]) if len(found) == 1 else None

    def runs(self, keys: set[str] | None = None) -> Iterator[Run]:
        """Yield the runs, all or those with the keys, in the order of their completion."""
        with self._using():
            for key, job, result in self._database.execute(
                    "select key, job, result from runs order by rowid"):
                if keys is None or key in keys:
                    yield _run(job, result)

    def close(self) -> None:
        """Close the file."""
        with self._using():
            self._database.close()

    @contextlib.contextmanager
    def _using(self) -> Iterator[None]:
        try:
            yield
        except (sqlite3.Error, *_NO_RUN) as error:
            raise StoreError(f"{self.path}: cannot be used: {' '.join(str(error).split())}; "
                             "choose another --out") from None


_NO_RUN = (ValueError, TypeError, LookupError, RecursionError, OSError)
"""Errors of decoding other bytes, or none."""


def _run(job: bytes, result: bytes) -> Run:
    return Run(msgspec.msgpack.decode(job, type=Job),
               msgspec.msgpack.decode(result, type=RunResult))
