"""Runs of a campaign: a cross product, or a random sample of all faults. Pure."""

from __future__ import annotations

import math
import random
from collections.abc import Iterable, Sequence
from itertools import product

import msgspec

from rampart.actors.bus.topic import ROOT
from rampart.actors.system.layout import published_keys
from rampart.actors.system.topics import system_topics
from rampart.manager.spec.schema import SystemSpec
from rampart.sim.campaign.job import Job
from rampart.sim.faults.faults import PROCESS_FAULTS, Faults, faults_of
from rampart.sim.faults.injector import can_be_hit
from rampart.sim.faults.scenario import ALL, PlannedFault
from rampart.sim.faults.topic_faults import systematic_faults

MOMENTS_S = 2.0, 120.0
"""Earliest and latest injection of random faults, simulated s; a system may have others."""

LASTS_S = (0.5, 15.0)
"""Shortest and longest random transient fault, simulated s."""

_FLICKER_S = (0.2, 2.0)
_DULL = ("diagnostic/", "inject/", "manager/shadow", "manager/adaptation",
         "manager/system")


def fault_groups(spec: SystemSpec) -> dict[str, tuple[str, ...]]:
    """Return the names of all faults of a system, by kind.

    Topics without influence on the robot (error reports, greetings, tools, adaptations) are left
    out.

    Raises:
        ValueError: The spec names an unknown actor class, or invalid topics.
    """
    nodes, faults = can_be_hit(spec), faults_of(spec)
    keys = [key for key in published_keys(spec)
            if not key.removeprefix(f"{ROOT}/").startswith(_DULL)]
    groups: dict[str, tuple[str, ...]] = {}
    for fault in (*faults.named.values(), *systematic_faults(keys, system_topics(spec))):
        groups[fault.group] = (*groups.get(fault.group, ()), fault.name)
    for kind, names in {
            "process": (*(f"{what}:{node}" for what, node in product(PROCESS_FAULTS, nodes)),
                        f"stop:{ALL}"),
            **faults.others}.items():
        groups[kind] = (*groups.get(kind, ()), *names)
    return groups


def cross(jobs: Sequence[Job], faults: Iterable[tuple[PlannedFault, ...]], seeds: Iterable[int]
          ) -> list[Job]:
    """Return every job with every set of faults and every seed.

    Args:
        jobs: Common parts: options, strategy, with or without FTM.
        faults: One set per run; an empty set is a run without a fault.
        seeds: Of the runs.
    """
    return [_with(job, fault, seed)
            for job, fault, seed in product(jobs, list(faults), list(seeds))]


def sample(jobs: Sequence[Job], groups: dict[str, tuple[str, ...]], runs: int, *, seed: int,
           faults: Faults, together: int = 1, moments: tuple[float, float] = MOMENTS_S
           ) -> list[Job]:
    """Return random runs: kind, fault, moment, duration, pattern and seed are drawn.

    A kind is drawn first, weighted by the square root of its number of faults, then one of its
    faults. So ten faults of actuators are not lost among seven hundred of topics, nor as frequent.
    A third of the faults is permanent, a third transient, and a third intermittent if it hits
    messages, else transient. A fault of a process has its default duration.

    Args:
        jobs: To choose from.
        groups: Names of faults by kind, see `fault_groups`.
        runs: Number of runs.
        faults: Of the robot: its named faults are of topics.
        seed: Of the choice; a longer sample begins with the shorter one.
        together: Number of faults per run.
        moments: Earliest and latest injection, simulated s.

    Raises:
        ValueError: There are no jobs or no faults to choose from.
    """
    weights = {kind: math.sqrt(len(names)) for kind, names in groups.items() if names}
    if not jobs or not weights:
        raise ValueError("campaign: there is nothing to choose from")
    chosen: list[Job] = []
    for number in range(runs):
        dice = random.Random(f"campaign {seed} {number}")  # noqa: S311 no secret
        wrong = tuple(_random_fault(dice, groups, weights, faults, moments)
                      for _ in range(together))
        job = dice.choice(list(jobs))
        chosen.append(_with(job, wrong, dice.randrange(1, 2**31)))
    return chosen


def _random_fault(dice: random.Random, groups: dict[str, tuple[str, ...]],
                  weights: dict[str, float], faults: Faults, moments: tuple[float, float]
                  ) -> PlannedFault:
    (kind,) = dice.choices(list(weights), list(weights.values()))
    fault = dice.choice(groups[kind])
    at_s = round(dice.uniform(*moments), 2)
    lasts_s = round(math.exp(dice.uniform(*map(math.log, LASTS_S))), 2)
    pattern = dice.choice(("permanent", "transient", "intermittent"))
    seed = dice.randrange(1000)
    if kind == "process":  # a killed process stays killed, a wedged one wedged
        return PlannedFault(fault, at_s)
    if pattern == "intermittent" and (kind in {"topic", "reading"} or fault in faults.named):
        on_s, off_s = (round(dice.uniform(*_FLICKER_S), 2) for _ in range(2))
        return PlannedFault(fault, at_s, duration_s=math.inf, on_s=on_s, off_s=off_s, seed=seed)
    return PlannedFault(fault, at_s, seed=seed,
                        duration_s=math.inf if pattern == "permanent" else lasts_s)


def _with(job: Job, faults: tuple[PlannedFault, ...], seed: int) -> Job:
    names = " + ".join(fault.fault for fault in faults) or "none"
    return msgspec.structs.replace(job, row=names, faults=faults, seed=seed)
