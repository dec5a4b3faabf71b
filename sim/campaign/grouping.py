"""Runs by the kind of their fault and by the conditions under which they were made. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import msgspec

from rampart.sim.campaign.job import (
    Job,
    application_of_system,
    faults_of_system,
    trial_of_system,
)
from rampart.sim.campaign.store import Run


@dataclass(frozen=True)
class Condition:
    """What some runs have in common besides their faults; `text` names only what varies."""

    text: str
    ftm: bool
    runs: list[Run]


def kind_of(job: Job) -> str:
    """Return in words the kind of what goes wrong in a run."""
    faults = faults_of_system(job.system)
    if len(job.faults) == 1:
        return faults.kinds[faults.kind_of(job.faults[0].fault)]
    return faults.kinds["several" if job.faults else "none"]


def by_kind(runs: Iterable[Run]) -> dict[str, list[Run]]:
    """Return the runs by kind, in the order of the robot's; kinds without runs are left out."""
    found: dict[str, list[Run]] = {}
    for run in runs:
        for kind in faults_of_system(run.job.system).kinds.values():
            found.setdefault(kind, [])
        found[kind_of(run.job)].append(run)
    return {kind: there for kind, there in found.items() if there}


def conditions(runs: Sequence[Run]) -> list[Condition]:
    """Return the runs by condition: the unprotected first, then by mechanisms and strategy."""
    said = _values(runs)
    varying = [name for name, values in said.items() if len(set(values) - {""}) > 1]
    groups: dict[tuple[str, ...], list[Run]] = {}
    for number, run in enumerate(runs):
        key = ("with FTM" if run.job.ftm else "without FTM",
               *(said[name][number] for name in varying))
        groups.setdefault(key, []).append(run)
    found = [Condition(", ".join(filter(None, key)), there[0].job.ftm, there)
             for key, there in groups.items()]
    return sorted(found, key=lambda condition: (condition.ftm, condition.text))


def in_common(runs: Sequence[Run]) -> list[str]:
    """Return in words what is the same in all runs."""
    found = [set(values) - {""} for values in _values(runs).values()]
    return [next(iter(values)) for values in found if len(values) == 1]


def varying_options(runs: Iterable[Run]) -> list[str]:
    """Return the options of the application that are not the same in all runs."""
    options = [run.job.options for run in runs]
    return [name for name in dict.fromkeys(name for each in options for name in each)
            if any(each.get(name) != options[0].get(name) for each in options)]


def _values(runs: Sequence[Run]) -> dict[str, list[str]]:
    """Return what makes up a condition besides FTM: what is said of each run, "" for nothing."""
    jobs = [run.job for run in runs]
    return {
        "mechanisms": [_mechanisms(job) for job in jobs],
        "strategy": [(job.strategy or "the system's strategy") if job.ftm else "" for job in jobs],
        "system": [f"system {job.system}" for job in jobs],
        **{name: [application_of_system(job.system).said(name, job.options[name])
                  if name in job.options else "" for job in jobs]
           for name in dict.fromkeys(name for job in jobs for name in job.options)},
        "network": [f"{job.network} network" for job in jobs],
        "patience": [f"given up after {job.patience_s:g} s without progress" for job in jobs],
    }


def _mechanisms(job: Job) -> str:
    if not job.ftm or not job.retuned:
        return "mechanisms as shipped" if job.ftm else ""
    for name, retuned in trial_of_system(job.system).retunings.items():
        if job.retuned == retuned:
            return name
    return "retuned " + msgspec.json.encode(job.retuned, order="deterministic").decode()
