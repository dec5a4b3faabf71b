"""Search for unsafe runs: an optimiser varies faults, times and places to minimise the margin.

Sampling finds common failures; following the margin down finds rare ones. The optimiser is a
tree-structured Parzen estimator (Bergstra et al. 2011, by Optuna). It handles names and numbers,
and numbers that exist only with some names. An unsafe run is then shrunk to what it needs.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import msgspec

from rampart.sim.campaign.job import Job, RunResult, application_of_system, run_job
from rampart.sim.campaign.plan import MOMENTS_S
from rampart.sim.faults.scenario import PlannedFault

if TYPE_CHECKING:
    import optuna

_LASTS_S = (0.3, 60.0)

Run = Callable[[Sequence[Job]], Sequence[RunResult]]
"""Runs jobs, perhaps in parallel, and returns their results in the same order."""


@dataclass(frozen=True, slots=True)
class Space:
    """Search space.

    Args:
        bases: Jobs without faults to choose from.
        groups: Names of faults by kind.
        intruder: Additional fault, see `Faults`.
        moments: Earliest and latest injection, simulated s.
        together: Number of faults per run.
    """

    bases: tuple[Job, ...]
    groups: Mapping[str, tuple[str, ...]]
    intruder: tuple[str, float, float] | None = None
    moments: tuple[float, float] = MOMENTS_S
    together: int = 1

    def job(self, trial: optuna.Trial, seed: int) -> Job:
        """Return the run that the optimiser chooses."""
        base = self.bases[trial.suggest_int("base", 0, len(self.bases) - 1)]
        faults = [self._fault(trial, f"{number} " if number > 1 else "")
                  for number in range(1, self.together + 1)]
        if self.intruder and trial.suggest_categorical("intruder", [False, True]):
            name, *limits = self.intruder
            size = round(trial.suggest_float("intruder_size", *limits), 2)
            after_s = round(trial.suggest_float("intruder_after_s", 0.0, 10.0), 2)
            faults.append(
                PlannedFault(f"{name}:{size:g}", round(faults[0].at_s + after_s, 2)))
        return msgspec.structs.replace(
            base, row=" + ".join(f.fault for f in faults), faults=tuple(faults), seed=seed)

    def _fault(self, trial: optuna.Trial, which: str) -> PlannedFault:
        kind = trial.suggest_categorical(f"{which}kind", sorted(self.groups))
        fault = trial.suggest_categorical(f"{which}fault of {kind}", self.groups[kind])
        at_s = round(trial.suggest_float(f"{which}at_s", *self.moments), 2)
        lasts_s = None if kind == "process" else round(
            trial.suggest_float(f"{which}lasts_s", *_LASTS_S, log=True), 2)
        return PlannedFault(fault, at_s, duration_s=lasts_s)


def margin(result: RunResult) -> float:
    """Return the value to minimise: the margin, or minus the severity of an unsafe run."""
    if result.safe:
        return result.margin
    return -result.severity


def search(space: Space, budget: int, run: Run, *, seed: int, seeds: int = 1, at_once: int = 1,
           seen: Callable[[Job, RunResult], None] = lambda _job, _result: None
           ) -> list[tuple[Job, RunResult]]:
    """Search for small margins; return all runs made, the worst first.

    Args:
        space: Search space.
        budget: Number of runs.
        run: See `Run`.
        seed: Of the optimiser and the first run.
        seeds: Number of seeds, from `seed` on, which the runs use in turn.
        at_once: Number of runs per call of `run`.
        seen: Called after each run.

    Raises:
        ImportError: Optuna is not installed.
    """
    import optuna  # noqa: PLC0415 an extra

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    with warnings.catch_warnings():  # three of its options are experimental
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        sampler = optuna.samplers.TPESampler(
            seed=seed, n_startup_trials=max(10, budget // 4), multivariate=True, group=True,
            constant_liar=True)
    study = optuna.create_study(direction="minimize", sampler=sampler)
    made: list[tuple[Job, RunResult]] = []
    while len(made) < budget:
        trials = [study.ask() for _ in range(min(at_once, budget - len(made)))]
        jobs = [space.job(trial, seed + trial.number % seeds) for trial in trials]
        for trial, job, result in zip(trials, jobs, run(jobs), strict=True):
            if result.counts and math.isfinite(margin(result)):
                study.tell(trial, margin(result))
            else:  # without effect or margin: worse than any other
                study.tell(trial, state=optuna.trial.TrialState.PRUNED)
            made.append((job, result))
            seen(job, result)
    return sorted(made, key=lambda pair: margin(pair[1]))


def shrink(job: Job, run: Callable[[Job], RunResult] = run_job,
           tried: Callable[[Job, bool], None] = lambda _job, _unsafe: None) -> Job:
    """Return a smaller run that is unsafe still.

    As long as the run stays unsafe, it removes whole faults, needless options, the pattern of a
    fault, half of its duration, digits of its time, the seed.

    Args:
        job: An unsafe run.
        run: Runs a job.
        tried: Called with each attempt and whether it was unsafe.

    Raises:
        ValueError: The run is not unsafe.
    """

    def unsafe(candidate: Job) -> bool:
        found = not run(candidate).safe
        tried(candidate, found)
        return found

    if not unsafe(job):
        raise ValueError(f"run {job.key} ({job.text()}) is safe, so it cannot be shrunk")
    smaller = True
    while smaller:
        smaller = False
        for candidate in _smaller(job):
            if candidate != job and unsafe(candidate):
                job, smaller = candidate, True
                break
    return job


def _smaller(job: Job) -> list[Job]:
    """Return simpler runs, the most simplified first."""
    found: list[Job] = []

    def change(**values: Any) -> None:
        found.append(msgspec.structs.replace(job, **values))

    for i in range(len(job.faults)):
        if len(job.faults) > 1:
            change(faults=(*job.faults[:i], *job.faults[i + 1:]))
    for options in application_of_system(job.system).simpler(job.options):
        change(options=options)
    for i, fault in enumerate(job.faults):
        for simpler in _simpler(fault):
            change(faults=(*job.faults[:i], simpler, *job.faults[i + 1:]))
    if job.seed != 1:
        change(seed=1)
    return found


def _simpler(fault: PlannedFault) -> list[PlannedFault]:
    replace = msgspec.structs.replace
    found = []
    if fault.on_s or fault.off_s or fault.share < 1:
        found.append(replace(fault, on_s=0.0, off_s=0.0, share=1.0))
    if fault.seed:
        found.append(replace(fault, seed=0))
    if fault.duration_s is not None and fault.duration_s > 0.2:
        shorter = 20.0 if fault.duration_s > 40 else round(fault.duration_s / 2, 2)
        found.append(replace(fault, duration_s=shorter))
    for digits in (-1, 0, 1):
        rounded = round(fault.at_s, digits)
        if rounded != fault.at_s and rounded > 0:
            found.append(replace(fault, at_s=rounded))
    return found
