"""Runs the jobs of a campaign: on all cores, resumable, each run once."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from typing import NamedTuple

import joblib

from rampart.sim.campaign.job import Job, RunResult, run_job
from rampart.sim.campaign.store import Store

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
