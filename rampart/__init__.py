"""Rampart: a fault-tolerant robot controller you can kill, node by node, while it works.

What is listed here is for classes and tests of one's own; `docs/api.md` says what each is for. A
name is imported when it is first used, so that a process that needs little starts soon.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rampart.actors.bus.envelope import Header
    from rampart.actors.bus.messages import InjectionReport, Message
    from rampart.actors.bus.topic import Qos, Topic
    from rampart.actors.bus.topics import INJECTION_REPORT
    from rampart.actors.detection.module import DetectionModule, Monitor
    from rampart.actors.detection.watchdog import Watchdog
    from rampart.actors.ftm.messages import DetectionState, RecoveryCommand
    from rampart.actors.operator.hmi import Hmi
    from rampart.actors.recovery.holding import HeldOrder
    from rampart.actors.recovery.module import RecoveryModule
    from rampart.actors.recovery.respawn import Respawn
    from rampart.actors.run.application import Application
    from rampart.actors.run.run_context import RunContext
    from rampart.actors.runtime.actor import Actor, Context, every, on
    from rampart.actors.runtime.checkpoint import StateFormat
    from rampart.actors.runtime.fault_watch import Order
    from rampart.actors.runtime.parameters import FieldName, Suspects
    from rampart.actors.runtime.timer import Timer
    from rampart.manager.analysis.verification import verify
    from rampart.manager.arbitration.arbiter import Arbiter, build_arbiter
    from rampart.manager.arbitration.arbiter_state import (
        DecisionMade,
        DetectionHeard,
        RecoveryHeard,
        ResetAsked,
        Tick,
    )
    from rampart.manager.arbitration.recovery_track import Command
    from rampart.manager.spec.panels import Panel
    from rampart.manager.spec.schema import SystemSpec
    from rampart.manager.spec.specification import parse_specification
    from rampart.manager.spec.tables import NonNegative, Positive, SpecificationError
    from rampart.manager.strategies.decision import Decision, Strategy
    from rampart.manager.strategies.registry import STRATEGIES, decide
    from rampart.sim.faults.disturbance import Disturbance, Fault
    from rampart.sim.faults.faults import Faults
    from rampart.sim.faults.scenario import ScenarioError
    from rampart.sim.runs.judge import Judge, Verdict

__all__ = [
    "INJECTION_REPORT",
    "STRATEGIES",
    "Actor",
    "Application",
    "Arbiter",
    "Command",
    "Context",
    "Decision",
    "DecisionMade",
    "DetectionHeard",
    "DetectionModule",
    "DetectionState",
    "Disturbance",
    "Fault",
    "Faults",
    "FieldName",
    "Header",
    "HeldOrder",
    "Hmi",
    "InjectionReport",
    "Judge",
    "Message",
    "Monitor",
    "NonNegative",
    "Order",
    "Panel",
    "Positive",
    "Qos",
    "RecoveryCommand",
    "RecoveryHeard",
    "RecoveryModule",
    "ResetAsked",
    "Respawn",
    "RunContext",
    "ScenarioError",
    "SpecificationError",
    "StateFormat",
    "Strategy",
    "Suspects",
    "SystemSpec",
    "Tick",
    "Timer",
    "Topic",
    "Verdict",
    "Watchdog",
    "build_arbiter",
    "decide",
    "every",
    "on",
    "parse_specification",
    "verify",
]

_HOMES = {
    "actors.bus.envelope": ("Header",),
    "actors.bus.messages": ("InjectionReport", "Message"),
    "actors.bus.topic": ("Qos", "Topic"),
    "actors.bus.topics": ("INJECTION_REPORT",),
    "actors.detection.module": ("DetectionModule", "Monitor"),
    "actors.detection.watchdog": ("Watchdog",),
    "actors.ftm.messages": ("DetectionState", "RecoveryCommand"),
    "actors.operator.hmi": ("Hmi",),
    "actors.recovery.holding": ("HeldOrder",),
    "actors.recovery.module": ("RecoveryModule",),
    "actors.recovery.respawn": ("Respawn",),
    "actors.run.application": ("Application",),
    "actors.run.run_context": ("RunContext",),
    "actors.runtime.actor": ("Actor", "Context", "every", "on"),
    "actors.runtime.checkpoint": ("StateFormat",),
    "actors.runtime.fault_watch": ("Order",),
    "actors.runtime.parameters": ("FieldName", "Suspects"),
    "actors.runtime.timer": ("Timer",),
    "manager.analysis.verification": ("verify",),
    "manager.arbitration.arbiter": ("Arbiter", "build_arbiter"),
    "manager.arbitration.arbiter_state": ("DecisionMade", "DetectionHeard", "RecoveryHeard",
        "ResetAsked", "Tick"),
    "manager.arbitration.recovery_track": ("Command",),
    "manager.spec.panels": ("Panel",),
    "manager.spec.schema": ("SystemSpec",),
    "manager.spec.specification": ("parse_specification",),
    "manager.spec.tables": ("NonNegative", "Positive", "SpecificationError"),
    "manager.strategies.decision": ("Decision", "Strategy"),
    "manager.strategies.registry": ("STRATEGIES", "decide"),
    "sim.faults.disturbance": ("Disturbance", "Fault"),
    "sim.faults.faults": ("Faults",),
    "sim.faults.scenario": ("ScenarioError",),
    "sim.runs.judge": ("Judge", "Verdict"),
}
"""Modules below `rampart`, and what is taken from each."""

_HOME_OF = {name: module for module, names in _HOMES.items() for name in names}


def __getattr__(name: str) -> Any:
    """Import a name of `__all__` from its module."""
    if name not in _HOME_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOME_OF[name]}"), name)


def __dir__() -> list[str]:
    """Return the public names."""
    return __all__
