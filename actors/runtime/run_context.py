"""Data that all actors of a run share: plan, system, application. Read-only."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from rampart.actors.ftm.messages import AdaptedSystem
from rampart.actors.runtime.application import Application
from rampart.actors.runtime.run_plan import RunPlan
from rampart.manager.spec.schema import SystemSpec

NO_SYSTEM = SystemSpec("none", "an actor without a system")


@dataclass(frozen=True, slots=True)
class RunContext:
    """Data of a run, loaded once before its processes are forked.

    Attributes:
        plan: the choices for the run.
        system: specification with all changes made while running, and without disabled layers.
        document: the specification as TOML data, which the manager changes; empty without a file.
        application: the robot's place and task.
        adapted: the last change of the system, or None.
        known_incarnations: newest issued incarnation by node, for a restarted supervisor.
        root: descriptor of a supervisor's connection to the root; -1 without one.
    """

    plan: RunPlan = field(default_factory=RunPlan)
    system: SystemSpec = NO_SYSTEM
    document: Mapping[str, Any] = field(default_factory=dict)
    application: Application = field(default_factory=Application)
    adapted: AdaptedSystem | None = None
    known_incarnations: Mapping[str, int] = field(default_factory=dict)
    root: int = -1
