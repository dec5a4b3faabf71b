"""What goes wrong in a soak: a fault every five seconds, by seed, of everything there is. Pure.

First each process is killed once. One that has replaced another has 1.7 MB more of its own than
those that were forked at the start, for it was a spare and has rehearsed; so all have made that
step when it begins to count whether memory grows.

Then half of the faults hit a process, from outside: any of the system, routers, spares, supervisor,
spawners, and the launcher and the world, which are only stopped for a moment. The other half are
those of messages, sensors, actuators and the world that the run's injector knows; they last less
than five seconds, so that one is over when the next one comes.
"""

from __future__ import annotations

import random
from dataclasses import dataclass

from rampart.manager.spec.schema import SystemSpec
from rampart.sim.campaign.plan import fault_groups
from rampart.sim.faults.scenario import PlannedFault
from tests.whole.chaos import WAYS, Targets, targets
from tests.whole.chaos_pairs import LAUNCHER, PAUSE

EVERY_S = 5.0
FIRST_S = 10.0
"""Simulated seconds of a mission at which the first fault comes."""

LASTS_S = (0.5, 4.0)


@dataclass(frozen=True, slots=True)
class Blow:
    """A process to be hit: when, simulated seconds of its mission, who and how."""

    at_s: float
    name: str
    way: str


@dataclass(frozen=True, slots=True)
class Plan:
    """What goes wrong in one mission, for as long as it may last."""

    blows: tuple[Blow, ...]
    faults: tuple[PlannedFault, ...]


def plan(spec: SystemSpec, seed: int, mission: int, length_s: float) -> Plan:
    """Return what goes wrong in a mission, counted from 0, of so many simulated seconds at most."""
    dice = random.Random(f"soak {seed} {mission}")
    of = targets(spec)
    groups = {kind: names for kind, names in fault_groups(spec).items()
              if kind != "process" and names}
    blows, faults = [], []
    first = dice.sample(of.mortal, len(of.mortal))
    for i in range(int((length_s - FIRST_S) / EVERY_S)):
        at_s = FIRST_S + i * EVERY_S
        if i < len(first):
            blows.append(Blow(at_s, first[i], "KILL"))
        elif dice.random() < 0.5:
            blows.append(_blow(dice, of, at_s))
        else:
            kind = dice.choice(list(groups))
            faults.append(PlannedFault(dice.choice(groups[kind]), at_s, duration_s=round(
                dice.uniform(*LASTS_S), 2)))
    return Plan(tuple(blows), tuple(faults))


def _blow(dice: random.Random, of: Targets, at_s: float) -> Blow:
    name = dice.choice((*of.mortal, *of.world, LAUNCHER))
    way = PAUSE if name in (*of.world, LAUNCHER) else dice.choice(WAYS)
    return Blow(at_s, name, way)
