"""Runs with a common beginning, which is made once and forked where a run departs from it.

Until its first fault a run equals the run without faults: same system, options, seed and messages.
So a worker makes that run, and forks at each first fault. The child continues as that run and sends
its result through a pipe. The worker waits for it, so each worker has one busy process, and then
continues to the next fault. A child that fails, is killed or does not end is one failed run.
"""

from __future__ import annotations

import os
import select
import signal
import threading
import time
from collections.abc import Sequence
from typing import NamedTuple

import msgspec

from rampart.sim.campaign.job import Job, RunResult, result_of, run_job, virtual_run
from rampart.sim.virtual.virtual_loop import fork

LONGEST_S = 3600.0
"""Longest time of a branch; one that takes longer counts as hung."""

AT_MOST = 25
"""Most runs in a group of a worker, which returns their results together."""


class Attempt(NamedTuple):
    """Key of a job, and its result, or an error in one line."""

    key: str
    result: RunResult | None
    error: str = ""


def attempt(job: Job) -> Attempt:
    """Make a run from its start; an error is returned as text, since not all can be pickled."""
    try:
        return Attempt(job.key, run_job(job))
    except Exception as error:
        return _failed(job, error)


def together(jobs: Sequence[Job], workers: int) -> list[list[Job]]:
    """Return the jobs in groups for `attempt_together`.

    Args:
        jobs: With different keys.
        workers: Number of workers; there are enough groups to keep all busy.
    """
    beginnings: dict[bytes, list[Job]] = {}
    for job in jobs:
        beginnings.setdefault(_beginning(job), []).append(job)
    size = max(1, min(AT_MOST, len(jobs) // (4 * workers)))
    found = []
    for group in beginnings.values():
        group.sort(key=_first_moment)  # so most groups end early
        found += [group[i:i + size] for i in range(0, len(group), size)]
    return found


def attempt_together(jobs: Sequence[Job], campaign: int) -> list[Attempt]:
    """Make runs with a common beginning.

    Args:
        jobs: A group of `together`.
        campaign: Process id of the campaign; without it a worker ends.
    """
    made = _Beginning(jobs, campaign).attempts() if len(jobs) > 1 else {}
    # Without a branch, because of threads for example, or of an invalid plan: from the start.
    return [made.get(number) or attempt(job) for number, job in enumerate(jobs)]


def _beginning(job: Job) -> bytes:
    """Return what runs have in common until their first fault; runs without faults are alone."""
    row = "" if job.faults else job.key
    return msgspec.msgpack.encode(
        msgspec.structs.replace(job, row=row, faults=()), order="deterministic")


def _first_moment(job: Job) -> tuple[int, float]:
    return min(((fault.goal, fault.at_s) for fault in job.faults), default=(0, 0.0))


def _failed(job: Job, error: Exception) -> Attempt:
    return _no_result(job, f"{type(error).__name__}: {' '.join(str(error).split())}")


def _no_result(job: Job, why: str) -> Attempt:
    return Attempt(job.key, None, f"run {job.key} ({job.text()}): {why}")


class _Beginning:
    """The common beginning of some runs, and in a child the run that departs from it."""

    def __init__(self, jobs: Sequence[Job], campaign: int) -> None:
        self._jobs = jobs
        self._campaign = campaign
        self._made: dict[int, Attempt] = {}
        self._job: Job | None = None
        self._pipe = -1
        self._sent = False
        self._begun_s = 0.0

    def attempts(self) -> dict[int, Attempt]:
        """Return the attempts of the branches, by number; in a child it does not return.

        The loop continues in the child, and so does everything above it on the stack. An interrupt
        may arrive during the fork, so each process other than the worker ends here.
        """
        worker = os.getpid()
        try:
            result = virtual_run(self._jobs[0]).branches(
                [job.faults for job in self._jobs], self._depart)
            if self._job is not None and result is not None:
                self._send(Attempt(self._job.key, result_of(result, self._begun_s)))
        except Exception as error:
            if self._job is not None:
                self._send(_failed(self._job, error))
        finally:
            if os.getpid() != worker:
                os._exit(0 if self._sent else 1)
        return self._made

    def _depart(self, number: int) -> bool:
        """Fork; return true in the child, and in the parent false when the child has ended."""
        if os.getpid() != self._campaign != os.getppid():
            os._exit(1)
        if threading.active_count() > 1:  # a child has only the forking one
            return False
        receiving, sending = os.pipe()
        try:
            child = fork()
        except OSError:
            os.close(receiving)
            os.close(sending)
            return False
        if child == 0:
            os.close(receiving)
            self._job, self._pipe, self._begun_s = self._jobs[number], sending, time.perf_counter()
            return True
        os.close(sending)
        self._made[number] = _received(self._jobs[number], child, receiving)
        return False

    def _send(self, made: Attempt) -> None:
        with os.fdopen(self._pipe, "wb") as pipe:
            pipe.write(msgspec.msgpack.encode(made))
        self._sent = True


def _received(job: Job, child: int, receiving: int) -> Attempt:
    """Return the attempt of a child, and reap it."""
    poll, until_s, data = select.poll(), time.monotonic() + LONGEST_S, b""
    poll.register(receiving)
    with os.fdopen(receiving, "rb", buffering=0) as pipe:
        while poll.poll(1e3 * max(until_s - time.monotonic(), 0.0)):
            more = pipe.read(1 << 16)
            if not more:
                break
            data += more
        else:
            os.kill(child, signal.SIGKILL)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    if code == 0:
        return msgspec.msgpack.decode(data, type=Attempt)
    return _no_result(job, "its process " + (
        f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with code {code}"))
