"""Runs the jobs of a campaign: on all cores or on a cluster, resumable, each run once."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import joblib

from rampart.sim.campaign.branches import Attempt, attempt, attempt_together, together
from rampart.sim.campaign.defaults import BACKENDS
from rampart.sim.campaign.job import Job, RunResult
from rampart.sim.campaign.store import Store

CONNECT_TIMEOUT_S = 10.0
"""Longest time to connect to a cluster."""

_ROUNDS = 4

Progress = Callable[[Job, RunResult], None]


class BackendError(ValueError):
    """A backend cannot be used; the message is one line."""


class JobError(RuntimeError):
    """A job could not be run; the message names it."""


def execute(jobs: Sequence[Job], store: Store, *, workers: int = 0, backend: str = "loky",
            address: str = "", progress: Progress = lambda _job, _result: None) -> int:
    """Run the jobs that are not in the store yet, and store each result as it arrives.

    Args:
        jobs: Jobs with the same key are run once.
        store: Gets each result in its own transaction. So whenever this process ends, the next call
            continues with the rest.
        workers: Processes; 0 for one per core, or all of the cluster.
        backend: See `BACKENDS`.
        address: Of the cluster's scheduler.
        progress: Called after each run.

    Returns:
        The number of runs made.

    Raises:
        BackendError: The backend is not installed, or no cluster answers at the address.
        JobError: A job is invalid, or failed; all others were run.
    """
    done = store.keys()
    waiting = {job.key: job for job in jobs if job.key not in done}
    if not waiting:
        return 0
    count = 0
    failed = []
    with _connected(backend, address):
        for key, result, error in _attempts(list(waiting.values()), workers, backend):
            if result is None:
                failed.append(error)
                continue
            store.add(waiting[key], result)
            count += 1
            progress(waiting[key], result)
    if failed:
        more = f" (and {len(failed) - 1} more)" if len(failed) > 1 else ""
        raise JobError(f"{failed[0]}{more}")
    return count


def _attempts(jobs: list[Job], workers: int, backend: str) -> Iterator[Attempt]:
    """Yield the attempts of jobs as soon as possible."""
    if backend == "loky":
        count = min(workers or os.cpu_count() or 1, len(jobs))
        groups = together(jobs, count)
        for made in _parallel(count)(
                joblib.delayed(attempt_together)(group, os.getpid()) for group in groups):
            yield from made
        return
    # Workers of a cluster have threads and cannot fork, so each run is made from its start.
    count = workers or -1
    attempts = [joblib.delayed(attempt)(job) for job in jobs]
    if backend != "ray":
        yield from _parallel(count)(attempts)
        return
    # Ray's backend returns all results together, so it gets few jobs at a time.
    some = _ROUNDS * joblib.effective_n_jobs(count)
    for start in range(0, len(attempts), some):
        yield from joblib.Parallel(n_jobs=count, batch_size=1)(attempts[start:start + some])


def _parallel(count: int) -> joblib.Parallel:
    return joblib.Parallel(n_jobs=count, return_as="generator_unordered", batch_size=1,
                           pre_dispatch="2*n_jobs")


@contextlib.contextmanager
def _connected(backend: str, address: str) -> Iterator[None]:
    if backend not in BACKENDS:
        raise BackendError(f"--backend {backend}: unknown; known: {', '.join(BACKENDS)}")
    if backend == "loky":
        with joblib.parallel_config(backend="loky", inner_max_num_threads=1):
            yield
        return
    connect = _dask if backend == "dask" else _ray
    with connect(address), joblib.parallel_config(backend=backend):
        yield


@contextlib.contextmanager
def _dask(address: str) -> Iterator[Any]:
    try:
        from distributed import Client  # noqa: PLC0415 an extra
    except ImportError:
        raise BackendError(
            "--backend dask: not installed; pip install 'rampart-robot[dask]'") from None
    if not address:
        raise BackendError("--backend dask: --address is missing, e.g. tcp://HOST:8786")
    try:
        client = Client(address, timeout=CONNECT_TIMEOUT_S)
    except OSError as error:
        raise BackendError(f"--address {address}: no dask scheduler: {error}") from None
    try:
        yield client
    finally:
        client.close()


@contextlib.contextmanager
def _ray(address: str) -> Iterator[Any]:
    try:
        import ray  # noqa: PLC0415 an extra
        from ray.util.joblib import register_ray  # noqa: PLC0415
    except ImportError:
        raise BackendError(
            "--backend ray: not installed; pip install 'rampart-robot[ray]'") from None
    if not address:
        raise BackendError("--backend ray: --address is missing, e.g. HOST:6379 or auto")
    try:
        ray.init(address=address, log_to_driver=False, logging_level="error")
    except (ConnectionError, ValueError) as error:
        raise BackendError(f"--address {address}: no ray cluster: "
                           f"{' '.join(str(error).split())[:200]}") from None
    register_ray()
    try:
        yield ray
    finally:
        ray.shutdown()
