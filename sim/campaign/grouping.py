"""Runs by the kind of their fault and by the conditions under which they were made. Pure."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import msgspec

from rampart.sim.campaign.job import Job, faults_of_system, trial_of_system
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
    """Return the runs by condition: the unprotected first, then by strategy and obstacles."""
    varying = {name for name, say in _SAID.items()
               if len({say(run.job) for run in runs} - {""}) > 1} | {"obstacles"}
    groups: dict[tuple[object, ...], list[Run]] = {}
    for run in runs:
        job = run.job
        key = (job.ftm, *(_SAID[name](job) for name in _SAID if name != "obstacles"),
               job.obstacles)
        groups.setdefault(key, []).append(run)
    return [Condition(_text(found[0].job, varying), found[0].job.ftm, found)
            for _, found in sorted(groups.items(), key=lambda item: repr(item[0]))]


def in_common(runs: Sequence[Run]) -> list[str]:
    """Return in words what is the same in all runs."""
    found = [{say(run.job) for run in runs} - {""} for name, say in _SAID.items()
             if name != "obstacles"]
    return [next(iter(values)) for values in found if len(values) == 1]


def _text(job: Job, varying: Iterable[str]) -> str:
    parts = ["with FTM" if job.ftm else "without FTM"]
    parts += [say(job) for name, say in _SAID.items() if name in varying]
    return ", ".join(part for part in parts if part)


def _strategy(job: Job) -> str:
    return (job.strategy or "the system's strategy") if job.ftm else ""


def _mechanisms(job: Job) -> str:
    if not job.ftm or not job.retuned:
        return "mechanisms as shipped" if job.ftm else ""
    for name, retuned in trial_of_system(job.system).retunings.items():
        if job.retuned == retuned:
            return name
    return "retuned " + msgspec.json.encode(job.retuned, order="deterministic").decode()


_SAID: dict[str, Callable[[Job], str]] = {
    "mechanisms": _mechanisms,
    "strategy": _strategy,
    "system": lambda job: f"system {job.system}",
    "airport": lambda job: f"airport {job.airport}" if job.airport else "",
    "mission": lambda job: f"mission {job.mission}" if job.mission else "",
    "network": lambda job: f"{job.network} network",
    "patience": lambda job: f"given up after {job.patience_s:g} s without progress",
    "obstacles": lambda job: f"{job.obstacles or 'no'} obstacle{'' if job.obstacles == 1 else 's'}",
}
"""What makes up a condition besides FTM, and how it is said of a job; empty if it says nothing."""
