"""What all actors of a run have in common: plan, system, application. Read-only."""

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
    """What is loaded once for a run, before its processes are forked.

    Attributes:
        plan: what was chosen for the run.
        system: the spec, as it was changed while running, with the layers that the plan leaves on.
        document: the same as TOML, as the manager changes it; empty without a file.
        application: what the robot's own actors know of place and task.
        adapted: the last change of the system; None if there was none.
        known_incarnations: for a restarted supervisor, those that were issued.
        root: for a supervisor, descriptor of its connection to the root; -1 without one.
    """

    plan: RunPlan = field(default_factory=RunPlan)
    system: SystemSpec = NO_SYSTEM
    document: Mapping[str, Any] = field(default_factory=dict)
    application: Application = field(default_factory=Application)
    adapted: AdaptedSystem | None = None
    known_incarnations: Mapping[str, int] = field(default_factory=dict)
    root: int = -1
