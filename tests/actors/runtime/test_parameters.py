"""Parameters of actors: a specification may set those that the class declares, and no others."""

import collections
import re

import msgspec
import pytest

from rampart import Actor, Context, SystemSpec, parse_specification, systems
from rampart.actors.bus import topics as bus_topics
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.airport.formats import load_airport
from rampart.actors.recovery.stub import StubRecovery
from rampart.actors.runtime.parameters import NodeNames, read_parameters
from rampart.actors.runtime.run_plan import RunPlan
from rampart.actors.system.layout import Layout
from rampart.actors.system.members import REPORTS_ON, load_class, load_member
from rampart.cli import systems as cli_systems
from rampart.manager.spec.tables import NonNegative, SpecificationError
from rampart.sim.virtual.virtual_bus import VirtualBus
from rampart.testing import run
from tests.manager.bench import FULL
from tests.osmosis_system import System, run_context
from tests.virtual_time import within

FILE = "osmosis.toml"
CHOSEN = collections.defaultdict(lambda: topics.COMMAND)
"""Any text may name a topic here; that there is one is checked when a system is loaded."""
SPECS = {path.name: parse_specification(path.read_text("utf-8"), str(path))
         for path in sorted(systems.SHIPPED.glob("*.toml"))}
FULL_SPEC = SPECS[FILE]
ACTORS = {node.actor: node for spec in SPECS.values() for node in spec.actors()}
STARTABLE = {"watch": ["osmosis_control"], "nodes": ["osmosis_control"],
             "topic": "control/command", "timeout_s": 1.0}
VALUES = (-1, 0, 1, 2.5, True, "x", "done", "acting", "safety_pilot", "control/command", [], {},
          [""], [3], ["nobody"], ["safety_pilot"], ["standby_control", "osmosis_control"],
          ["osmosis_control", "osmosis_control"], ["safety_pilot", "standby_control"], ["RM1"])


def plan(file: str) -> RunPlan:
    return RunPlan(seed=5, system_file=file)


def said(table: str, name: str, **parameters) -> SystemSpec:
    """The full system with other parameters of one module."""
    rows = tuple(msgspec.structs.replace(row, parameters={**row.parameters, **parameters})
                 if row.name == name else row for row in getattr(FULL_SPEC, table))
    return msgspec.structs.replace(FULL_SPEC, **{table: rows})


def refusal(spec: SystemSpec) -> str:
    with pytest.raises(SpecificationError) as caught:
        Layout(plan(FILE), spec)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_what_plan_and_spec_say_is_given_to_the_actors_that_take_it():
    members = Layout(plan(FILE), said("nodes", "simulator", obstacles=1)).members
    assert members["RM4"].parameters.nodes == ("localization", "hmi", "teleoperation")
    world = members["simulator"].parameters
    assert (world.seed, world.obstacles, world.dead_man, world.upper_laser) == (5, 1, True, True)
    rows = tuple(msgspec.structs.replace(row, actor="rampart.actors.recovery.stub:StubRecovery")
                 if row.name == "RM4" else row for row in FULL_SPEC.recoveries)
    members = Layout(plan(FILE), msgspec.structs.replace(FULL_SPEC, recoveries=rows)).members
    assert members["RM4"].parameters == StubRecovery.Parameters()


@pytest.mark.parametrize(("table", "name", "parameters", "words"), [
    ("detections", "DM2", {"timeout_s": True}, "timeout_s = True: expected a number > 0"),
    ("detections", "DM2", {"timeout_s": 0.1}, "timeout_s = 0.1: would raise false alarms"),
    ("detections", "DM4", {"watch": []}, r"watch = \[\]: expected a list of node names"),
    ("detections", "DM2", {"suspects": ["osmosis"]}, "suspects = .*unknown node 'osmosis'; known"),
    ("detections", "DM9", {"suspects": ["osmosis_control", "osmosis_control"]},
     "suspects = .*: expected osmosis_control and its standby"),
    ("nodes", "teleoperation", {"linear_mps": -1}, "linear_mps = -1: .* 0 or more"),
])
def test_what_an_actor_does_not_take_is_refused_with_file_path_and_what_would_be_right(
        table, name, parameters, words):
    assert re.match(rf"{FILE}: \w+ {name}: parameters\.{words}",
                    refusal(said(table, name, **parameters)))


def test_a_look_at_a_spec_refuses_parameters_of_the_modules_that_ship(tmp_path):
    file = tmp_path / "own.toml"
    file.write_text(FULL.replace("margin_m = 0.6,", "margin_m = 0.6, hold = 1,"))
    words = f"{file}: detection DM1: parameters.hold = 1: unknown field; known: margin_m"
    with pytest.raises(ValueError, match=re.escape(words)):
        cli_systems.load(str(file))


def test_a_look_at_a_spec_imports_nothing_of_its_author_s(tmp_path):
    file = tmp_path / "own.toml"
    file.write_text(FULL.replace("rampart.actors.osmosis.detection.bounds:Bou", "no.such:Bou"))
    assert cli_systems.load(str(file)).detections[2].actor == "no.such:Bounds"


# -- custom actors -------------------------------------------------------------------------


class Lamp(Actor):
    """Declares parameters."""

    class Parameters(Actor.Parameters, frozen=True, kw_only=True):
        brightness_cd: NonNegative
        near: NodeNames = ("hmi",)
        place_m: tuple[float, float] = (0.0, 0.0)

    parameters: Parameters


@pytest.mark.parametrize(("parameters", "words"), [
    ({}, ": required field 'brightness_cd' is missing"),
    ({"brightness_cd": 1, "near": ["nobody"]},
     ".near = ['nobody']: unknown node 'nobody'; known: mission_manager"),
    ({"brightness_cd": 1, "place_m": [1]}, ".place_m = [1]: Expected array of length 2, got 1"),
])
def test_the_parameters_of_an_actor_of_one_s_own_are_checked_likewise(parameters, words):
    spec = said("nodes", "hmi", **parameters)
    node = msgspec.structs.replace(
        next(n for n in spec.nodes if n.name == "hmi"), actor=f"{__name__}:Lamp",
        parameters=parameters)
    where = "x.toml: node hmi: parameters"
    with pytest.raises(SpecificationError, match=re.escape(where + words)):
        load_member(node, spec, "x.toml")


@within(System)
async def test_an_actor_of_one_s_own_reads_its_parameters_by_their_names(system):
    lamp = system.start("lamp", Lamp, brightness_cd=3)
    assert (lamp.parameters.brightness_cd, lamp.parameters.near) == (3.0, ("hmi",))
    with pytest.raises(SpecificationError, match=r"^lamp: parameters\.brightness_cd = -1"):
        system.start("lamp", Lamp, brightness_cd=-1)


# -- the actors that ship ------------------------------------------------------------------------


def test_each_parameter_is_documented_where_it_is_declared():
    for path in ACTORS:
        texts = [base.__doc__ or "" for base in load_class(path).Parameters.__mro__]
        for field in msgspec.structs.fields(load_class(path).Parameters):
            assert any(re.search(rf"^\s*{field.name}: \S", text, re.MULTILINE) or (
                field.name == "nodes" and "names of all nodes" in text)
                for text in texts), f"{path}: {field.name}"


@pytest.mark.parametrize("path", [p for p, node in ACTORS.items() if node.kind in REPORTS_ON])
def test_a_module_starts_with_every_value_that_is_accepted(path):
    cls = load_class(path)
    fields = msgspec.structs.fields(cls.Parameters)
    needed = {f.name: STARTABLE[f.name] for f in fields if f.required}

    async def scenario() -> None:
        system, airport = System(), load_airport("vallombre")
        for field in fields:
            accepted = 0
            for value in VALUES:
                try:
                    parameters = read_parameters(
                        cls.Parameters, {**needed, field.name: value}, "f", "p", FULL_SPEC)
                except SpecificationError:
                    continue
                accepted += 1
                cls(Context("X", 1, system.clock, VirtualBus(system.hub, "X", 1), parameters,
                            run_context(system=FULL_SPEC, airport=airport), topics=CHOSEN))
                cls.names(bus_topics.HEARTBEAT, "X", parameters)
            assert 0 < accepted < len(VALUES), field.name

    run(scenario)
