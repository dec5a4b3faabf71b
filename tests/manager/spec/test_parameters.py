"""What the loader accepts as parameters of a shipped module is what the module can start with."""

from __future__ import annotations

import pkgutil
from collections.abc import Iterator
from importlib import import_module, resources
from typing import Any

import pytest

from rampart.actors.bus import topics
from rampart.actors.detection.module import DetectionModule
from rampart.actors.osmosis.airport.formats import load_airport
from rampart.actors.recovery.module import RecoveryModule
from rampart.actors.runtime.actor import Context
from rampart.manager.spec.parameters import NEEDS, TAKES, find_wrong
from rampart.sim.virtual.virtual_bus import VirtualBus
from rampart.testing import run
from tests.osmosis_system import System, run_context, shipped_system

BASES = {"Freshness", "PilotRecovery"}
NODES = ("osmosis_control", "standby_control", "safety_pilot")
STARTABLE = {"watch": ["osmosis_control"], "nodes": ["osmosis_control"]}
FOR_THE_ANALYSES = {"rampart.actors.detection.stub:StubDetection":
                        {"timeout_s", "margin_m", "watch"},
                    "rampart.actors.osmosis.detection.freshness:CommandFreshness": {"topic"},
                    "rampart.actors.osmosis.detection.freshness:LocalizationFreshness": {"topic"}}
VALUES = (-1, 0, 1, 2.5, True, "x", "done", "acting", "safety_pilot", "control/command", [], {},
          [""], [3], ["nobody"], ["safety_pilot"], ["standby_control", "osmosis_control"],
          ["osmosis_control", "osmosis_control"], ["safety_pilot", "standby_control"])


class Read(dict[str, Any]):
    """Parameters that remember which of them were asked for."""

    def __init__(self, values: dict[str, Any]) -> None:
        super().__init__(values)
        self.keys_read: set[str] = set()

    def get(self, key: str, default: Any = None) -> Any:
        self.keys_read.add(key)
        return super().get(key, default)

    def __getitem__(self, key: str) -> Any:
        self.keys_read.add(key)
        return super().__getitem__(key)

    def __contains__(self, key: object) -> bool:
        self.keys_read.add(str(key))
        return super().__contains__(key)


def shipped() -> Iterator[type[Any]]:
    for room in ("detection", "recovery", "osmosis.detection", "osmosis.recovery"):
        package = f"rampart.actors.{room}"
        for found in pkgutil.walk_packages([str(resources.files(package))], package + "."):
            module = import_module(found.name)
            for cls in vars(module).values():
                if isinstance(cls, type) and issubclass(cls, DetectionModule | RecoveryModule) \
                        and cls.__module__ == module.__name__ and cls.__name__ not in BASES \
                        and cls not in {DetectionModule, RecoveryModule}:
                    yield cls


CLASSES = {f"{cls.__module__}:{cls.__name__}": cls for cls in shipped()}


def start(path: str, **values: Any) -> set[str]:
    """Make the actor as a process would, and return which parameters it has read."""
    parameters = Read({NEEDS[path]: STARTABLE[NEEDS[path]]} if path in NEEDS else {})
    parameters.update(values)
    cls = CLASSES[path]

    async def scenario() -> None:
        system = System()
        cls(Context("X", 1, system.clock, VirtualBus(system.hub, "X", 1), parameters,
                    run_context(system=shipped_system(), airport=load_airport("vallombre"))))
        cls.names(topics.HEARTBEAT, "X", parameters)
        cls.watches("X", parameters)

    run(scenario)
    return parameters.keys_read


def test_every_shipped_module_is_in_the_table():
    assert CLASSES.keys() == TAKES.keys()


@pytest.mark.parametrize("path", TAKES)
def test_a_module_takes_the_parameters_that_it_reads_and_no_others(path):
    assert start(path) | FOR_THE_ANALYSES.get(path, set()) == TAKES[path].keys()


@pytest.mark.parametrize("path", TAKES)
def test_a_module_starts_with_every_value_that_is_accepted(path):
    for name in TAKES[path]:
        accepted = [v for v in VALUES if not [
            found for found in find_wrong(path, {name: v}, NODES, STARTABLE) if found[0] == name]]
        for value in accepted:
            start(path, **{name: value})
        assert accepted or name == "topic", name
        assert len(accepted) < len(VALUES), name


@pytest.mark.parametrize("path", NEEDS)
def test_what_a_module_needs_may_be_derived_but_not_left_out(path):
    assert dict(find_wrong(path, {}, NODES)) == {
        NEEDS[path]: "missing; without it the module does not start"}
    assert not list(find_wrong(path, {}, NODES, [NEEDS[path]]))
