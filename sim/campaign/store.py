"""Runs the jobs of a campaign, each once, and stores the results.

The jobs run on all cores. The store is an SQLite file with each run once, sound after any crash. So
a campaign can be continued.
"""

from __future__ import annotations

import contextlib
import os
import sqlite3
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import NamedTuple

import joblib
import msgspec

from rampart.sim.campaign.job import Job, RunResult, run_job

FILE_NAME = "runs.sqlite"

_SCHEMA = """create table if not exists runs (
    key text primary key, job blob not null, result blob not null,
    finished_at text not null default current_timestamp)"""


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
        StoreError: The file is not a store.
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
            self._database.execute(_SCHEMA)
        except sqlite3.Error as error:
            raise StoreError(f"{self.path}: not a store of campaign results: {error}") from None

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


# -- execution ---------------------------------------------------------------------------------


Progress = Callable[[Job, RunResult], None]


class JobError(RuntimeError):
    """A job could not be run; the message names it, or says that a process was killed."""


class Attempt(NamedTuple):
    """Key of a job, and its result, or an error in one line."""

    key: str
    result: RunResult | None
    error: str = ""


def execute(jobs: Sequence[Job], store: Store, *, workers: int = 0,
            progress: Progress = lambda _job, _result: None) -> int:
    """Run the jobs that are not in the store yet, and store each result as it arrives.

    Args:
        jobs: Jobs with the same key are run once.
        store: Gets each result in its own transaction. So whenever this process ends, the next call
            continues with the rest.
        workers: Processes; 0 for one per core.
        progress: Called after each run.

    Returns:
        The number of runs made.

    Raises:
        JobError: A job is invalid, or failed, and all others were run; or a process was killed.
    """
    done = store.keys()
    waiting = {job.key: job for job in jobs if job.key not in done}
    if not waiting:
        return 0
    count = 0
    failed = []
    try:
        for key, result, error in _attempts(list(waiting.values()), workers):
            if result is None:
                failed.append(error)
                continue
            store.add(waiting[key], result)
            count += 1
            progress(waiting[key], result)
    except BrokenProcessPool as error:
        failed.append(f"a process that made runs was killed: {' '.join(str(error).split())}")
    if failed:
        more = f" (and {len(failed) - 1} more)" if len(failed) > 1 else ""
        raise JobError(f"{failed[0]}{more}")
    return count


def _attempts(jobs: list[Job], workers: int) -> Iterator[Attempt]:
    """Yield the attempts of jobs as soon as possible."""
    count = min(workers or os.cpu_count() or 1, len(jobs))
    with joblib.parallel_config(backend="loky", inner_max_num_threads=1):
        yield from joblib.Parallel(
            n_jobs=count, return_as="generator_unordered", batch_size=1, pre_dispatch="2*n_jobs")(
                joblib.delayed(_attempt)(job) for job in jobs)


def _attempt(job: Job) -> Attempt:
    """Make a run; an error is returned as text, since not all can be pickled."""
    try:
        return Attempt(job.key, run_job(job))
    except Exception as error:
        why = f"{type(error).__name__}: {' '.join(str(error).split())}"
        return Attempt(job.key, None, f"run {job.key} ({job.text()}): {why}")
