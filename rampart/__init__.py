"""Rampart: a fault-tolerant robot controller you can kill, node by node, while it works.

What is listed here is for classes and tests of one's own; `docs/api.md` says what each is for. A
name is imported when it is first used, so that a process that needs little starts soon.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rampart.actors.bus.envelope import Header as Header
    from rampart.actors.bus.messages import InjectionReport as InjectionReport
    from rampart.actors.bus.messages import Message as Message
    from rampart.actors.bus.topic import Qos as Qos
    from rampart.actors.bus.topic import Topic as Topic
    from rampart.actors.bus.topics import INJECTION_REPORT as INJECTION_REPORT
    from rampart.actors.detection.module import DetectionModule as DetectionModule
    from rampart.actors.detection.module import Monitor as Monitor
    from rampart.actors.detection.watchdog import Watchdog as Watchdog
    from rampart.actors.ftm.messages import DetectionState as DetectionState
    from rampart.actors.ftm.messages import RecoveryCommand as RecoveryCommand
    from rampart.actors.operator.hmi import Hmi as Hmi
    from rampart.actors.recovery.holding import HeldOrder as HeldOrder
    from rampart.actors.recovery.module import RecoveryModule as RecoveryModule
    from rampart.actors.recovery.respawn import Respawn as Respawn
    from rampart.actors.run.application import Application as Application
    from rampart.actors.run.run_context import RunContext as RunContext
    from rampart.actors.runtime.actor import Actor as Actor
    from rampart.actors.runtime.actor import Context as Context
    from rampart.actors.runtime.actor import every as every
    from rampart.actors.runtime.actor import on as on
    from rampart.actors.runtime.checkpoint import StateFormat as StateFormat
    from rampart.actors.runtime.fault_watch import Order as Order
    from rampart.actors.runtime.parameters import FieldName as FieldName
    from rampart.actors.runtime.parameters import Suspects as Suspects
    from rampart.actors.runtime.timer import Timer as Timer
    from rampart.manager.analysis.verification import verify as verify
    from rampart.manager.arbitration.arbiter import Arbiter as Arbiter
    from rampart.manager.arbitration.arbiter import build_arbiter as build_arbiter
    from rampart.manager.arbitration.arbiter_state import DecisionMade as DecisionMade
    from rampart.manager.arbitration.arbiter_state import DetectionHeard as DetectionHeard
    from rampart.manager.arbitration.arbiter_state import RecoveryHeard as RecoveryHeard
    from rampart.manager.arbitration.arbiter_state import ResetAsked as ResetAsked
    from rampart.manager.arbitration.arbiter_state import Tick as Tick
    from rampart.manager.arbitration.recovery_track import Command as Command
    from rampart.manager.spec.panels import Panel as Panel
    from rampart.manager.spec.schema import SystemSpec as SystemSpec
    from rampart.manager.spec.specification import parse_specification as parse_specification
    from rampart.manager.spec.tables import NonNegative as NonNegative
    from rampart.manager.spec.tables import Positive as Positive
    from rampart.manager.spec.tables import SpecificationError as SpecificationError
    from rampart.manager.strategies.decision import Decision as Decision
    from rampart.manager.strategies.decision import Strategy as Strategy
    from rampart.manager.strategies.registry import STRATEGIES as STRATEGIES
    from rampart.manager.strategies.registry import decide as decide
    from rampart.sim.faults.disturbance import Disturbance as Disturbance
    from rampart.sim.faults.disturbance import Fault as Fault
    from rampart.sim.faults.faults import Faults as Faults
    from rampart.sim.faults.scenario import ScenarioError as ScenarioError
    from rampart.sim.runs.judge import Judge as Judge
    from rampart.sim.runs.judge import Verdict as Verdict

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
__all__ = list(_HOME_OF)


def __getattr__(name: str) -> Any:
    """Import a name of `__all__` from its module."""
    if name not in _HOME_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOME_OF[name]}"), name)


def __dir__() -> list[str]:
    """Return the public names."""
    return __all__
