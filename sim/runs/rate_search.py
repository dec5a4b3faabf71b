"""`--rate max`: the rate with which this machine keeps up, found by trying.

Short runs of the real system, all of its processes included, each at one rate. Whether the machine
kept up is a matter of how late event loops were (`rampart.sim.runs.keeping_up`), not of processor
use: what counts is what a system's timeouts bear, and what else the machine has to do counts too.
"""

from __future__ import annotations

import asyncio
import math
import os
import time
import uuid
from collections.abc import Awaitable, Callable

from rampart.sim.runs.keeping_up import KeptUp
from rampart.sim.runs.process_run import ProcessRun
from rampart.sim.runs.trial import Trial

LEAST, MOST = 0.1, 20
"""Rates that can be asked for."""

PROBE_S = 6.0
"""Real seconds of a trial run, beginning with simulated time 0."""

_TRIALS = 5
_SHARE = 0.8
"""Of the rate that was tried: in a trial nothing fails and nothing is planned anew."""

_LOOK_S = 0.05


def first_rate() -> float:
    """Return the rate to try first: one for each processor that may be used."""
    return min(max(1.0, float(len(os.sched_getaffinity(0)))), MOST)


async def find_rate(probe: Callable[[float], Awaitable[KeptUp]], say: Callable[[str], None],
                    first: float) -> float:
    """Return the rate with which a machine keeps up, with something to spare.

    It doubles what is tried until the machine does not keep up, or goes down to what the lateness
    suggests until it does.

    Args:
        probe: runs the system at a rate and returns how it kept up.
        say: is told of each trial.
        first: rate that is tried first.
    """
    rate, kept_up_with, too_much = first, 0.0, math.inf
    for _ in range(_TRIALS):
        found = await probe(rate)
        late = (f"loops up to {1e3 * found.late_s:.0f} ms late, {1e3 * found.allowed_s:.0f} are in "
                "order")
        if found.with_rate >= rate:
            say(f"rate {rate:g} tried: this machine keeps up ({late})")
            kept_up_with, rate = rate, min(2 * rate, MOST)
            if rate >= too_much or rate == kept_up_with:
                break
        else:
            say(f"rate {rate:g} tried: this machine does not keep up ({late})")
            if kept_up_with or rate <= LEAST:
                break
            too_much, rate = rate, _tenths(max(LEAST, min(found.with_rate, 0.7 * rate)))
    return max(LEAST, _tenths(_SHARE * (kept_up_with or rate)))


def _tenths(rate: float) -> float:
    return math.floor(10 * rate + 1e-6) / 10


async def probe_run(trial: Callable[[float, str], Trial], rate: float) -> KeptUp:
    """Run a system for a moment and return how the machine kept up.

    Args:
        trial: returns what is run, by its rate and the name of the run.
        rate: simulated seconds per second.

    Raises:
        LaunchError: the system cannot be started.
    """
    run = ProcessRun(trial(rate, uuid.uuid4().hex[:12]))

    async def end() -> None:
        while not run.launcher.plan.origin_s:  # noqa: ASYNC110 polled, until all is loaded
            await asyncio.sleep(_LOOK_S)
        await asyncio.sleep(run.launcher.plan.origin_s + PROBE_S - time.monotonic())
        run.interrupted = "it was a trial"

    ending = asyncio.create_task(end())
    try:
        record = await run.run()
    finally:
        ending.cancel()
    if record.keeping_up is None:
        raise TypeError("a run on processes is measured")
    return record.keeping_up
