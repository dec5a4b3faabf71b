"""Connections and parameters of a system's actors are checked before a run, errors are one line.

A specification may set the parameters that the class declares, and no others.
"""

import collections
import importlib
import re
import sys
import textwrap

import msgspec
import pytest

from rampart import Actor, Context, SystemSpec, parse_specification, systems
from rampart.actors.bus import topics as bus_topics
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.airport.formats import load_airport
from rampart.actors.recovery.stub import StubRecovery
from rampart.actors.runtime.parameters import NodeNames, read_parameters
from rampart.actors.runtime.run_plan import RunPlan, load_system
from rampart.actors.system.layout import Layout
from rampart.actors.system.members import REPORTS_ON, load_class, load_member
from rampart.cli import systems as cli_systems
from rampart.manager.spec.tables import NonNegative, SpecificationError
from rampart.sim.virtual.virtual_bus import VirtualBus
from rampart.testing import run
from tests import system_file
from tests.manager.bench import FULL
from tests.osmosis_system import System, run_context
from tests.virtual_time import within

HEAD = """
from rampart import Actor, Header, Message, Qos, Topic, every, on
from rampart.sim.runs.judge import Judge, Verdict

class Level(Message):
    level_m: float

class Flow(Message):
    flow: float

LEVEL = Topic("tank/level", Level, Qos.SENSOR, 10, "", "Level.")
LEVLE = Topic("tank/levle", Level, Qos.SENSOR, 10, "", "A typo.")
AGAIN = Topic("tank/level", Flow, Qos.SENSOR, 10, "", "The same key.")
SHARED = Topic("tank/level", Level, Qos.SENSOR, 10, "", "Level.", several=True)
VALVE = Topic("tank/valve/{name}", Flow, Qos.STATE, 10, "", "Each valve's.")
ORDER = Topic("tank/order", Flow, Qos.COMMAND, 0, "", "Orders.")
OUTSIDE = Topic("tank/stick", Level, Qos.SENSOR, 10, "", "A tool's.", outside=True)

class Gauge(Actor):
    outputs = (LEVEL,)

class Second(Gauge):
    pass

class Pump(Actor):
    @on(LEVEL)
    def level(self, message, header):
        pass
"""
NODE = '[[node]]\nname = "{}"\nactor = "tank_here:{}"\nkind = "{}"\n'
TIMEOUTS = "".join(f"{name}_timeout_s = 1.0\n" for name in (
    "heartbeat", "command", "localization", "scan", "dead_man", "manager"))
SPEC = 'name = "tank"\ntitle = "A tank"\n[timing]\n' + TIMEOUTS + (
    "detection_silence_timeout_s = 1.0\n[layers]\nftm = false\n[orders.safer]\n"
    '[[event]]\nname = "overflow"\n')


@pytest.fixture
def tank(tmp_path, monkeypatch):
    """Return a function that lays out a tank: more code, its nodes by class, and more TOML."""
    monkeypatch.syspath_prepend(str(tmp_path))

    def laid_out(code: str, *nodes: str, more: str = "", kind: str = "control") -> Layout:
        (tmp_path / "tank_here.py").write_text(HEAD + textwrap.dedent(code))
        rows = "".join(NODE.format(name.lower(), name, kind) for name in nodes)
        (tmp_path / "tank.toml").write_text(SPEC + rows + more)
        sys.modules.pop("tank_here", None)
        importlib.invalidate_caches()
        plan = RunPlan(system_file=str(tmp_path / "tank.toml"))
        return Layout(plan, load_system(plan))

    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    yield laid_out
    sys.modules.pop("tank_here", None)


def line_of(call, *arguments, **options) -> str:
    with pytest.raises(ValueError, match=r".") as caught:
        call(*arguments, **options)
    assert "\n" not in str(caught.value)
    return str(caught.value).partition("tank.toml: ")[2]


HEARS = "class Reader(Actor):\n    @on({})\n    def level(self, message, header): pass\n"


def test_a_topic_that_nothing_publishes_is_a_typo_unless_it_is_optional_or_from_outside(tank):
    assert line_of(tank, HEARS.format("LEVLE"), "Gauge", "Reader").startswith(
        "node reader: hears 'tank/levle', which nothing publishes; did you mean 'tank/level'? ")
    optional = HEARS.format("LEVLE") + "    optional_inputs = (LEVLE,)\n"
    for code in (optional, HEARS.format("OUTSIDE")):
        assert "reader" in tank(code, "Gauge", "Reader").members


FAMILY = """
class Valve(Actor):
    outputs = (VALVE,)

class Reader(Actor):
    @on(VALVE)
    def level(self, message, header): pass

    @classmethod
    def names(cls, topic, name, parameters):
        return {}
"""


def test_each_member_of_a_family_that_is_heard_has_to_be_published(tank):
    assert "reader" in tank(FAMILY.format('("valve",)'), "Valve", "Reader").members
    assert "reader" in tank(FAMILY.format("None"), "Valve", "Reader").members
    assert line_of(tank, FAMILY.format('("valve", "vlave")'), "Valve", "Reader").startswith(
        "node reader: hears 'tank/valve/vlave', which nothing publishes; did you mean "
        "'tank/valve/valve'? ")


@pytest.mark.parametrize(("field", "where"), [
    ("speed: np.float64", "field speed: numpy.float64"),
    ("inner: Level\n    all: tuple[np.ndarray, ...] = ()", "field all[]: numpy.ndarray")])
def test_a_field_that_cannot_be_sent_is_refused_by_topic_and_name(tank, field, where):
    code = (f"import numpy as np\nclass Pose(Message):\n    {field}\n"
            'POSE = Topic("tank/pose", Pose, Qos.SENSOR, 10, "", "Pose.")\n'
            "class Eye(Actor):\n    outputs = (POSE,)\n")
    line = line_of(tank, code, "Eye")
    assert line.startswith(f"node eye: topic 'tank/pose': {where} cannot be sent")


def test_a_repair_has_to_reach_the_nodes_that_its_detection_watches(tmp_path):
    text = system_file("paper").read_text()
    assert 'respawn = "RM3"' in text
    file = tmp_path / "paper.toml"
    # One control node is the supervisor's now, and DM4, to which RM3 answers, watches it still.
    file.write_text(text.replace('respawn = "RM3"', 'respawn = "supervisor"', 1))
    plan = RunPlan(system_file=str(file))
    with pytest.raises(ValueError, match=r"parameters\.watch: RM3 answers .* mission_manager"):
        Layout(plan, load_system(plan))


JUDGE = """
class Fair(Judge):
    @on({})
    def level(self, message, header): pass
"""


def test_one_key_with_two_types(tank):
    line = "topic 'tank/level' is tank_here:Flow of qos sensor, and tank_here:Level of "
    assert line_of(tank, HEARS.format("AGAIN"), "Gauge", "Reader").startswith(
        f"node reader: {line}")
    judge = '[judge]\nclass = "tank_here:Fair"\n'
    assert line_of(tank, JUDGE.format("AGAIN"), "Gauge", more=judge).startswith(
        f"$.judge: Fair: {line}")
    assert tank(JUDGE.format("LEVEL"), "Gauge", more=judge).spec.judge["class"] == "tank_here:Fair"


def test_two_publishers_of_what_is_one_node_s_to_say(tank):
    assert line_of(tank, "", "Gauge", "Second", "Pump").startswith(
        "node second: publishes 'tank/level', as node gauge does; ")
    both = "class Other(Actor):\n    outputs = ({},)\n\nclass Third(Other): pass\n"
    for allowed in ("ORDER", "SHARED", "VALVE"):
        assert len(tank(both.format(allowed), "Other", "Third").members) == 4
    same = ("    @classmethod\n    def output_names(cls, topic, name, parameters): return "
            "('inlet',)\n\nclass Third(Other): pass\n")
    assert line_of(tank, f"class Other(Actor):\n    outputs = (VALVE,)\n{same}", "Other",
                   "Third").startswith("node third: publishes 'tank/valve/{name}', as node other")


@pytest.mark.parametrize(("code", "cause"), [
    ("class Reader(Pump):\n    async def level(self, message, header): pass\n",
     "TypeError: Reader.level is an async def"),
    (HEARS.format("LEVEL").replace("pass", "yield"), "TypeError: Reader.level has a yield"),
    (HEARS.format("LEVEL").replace(", header", ""),
     "TypeError: Reader.level: expected def level(self, "),
    (HEARS.format("Level"), "TypeError: @on(Level): expected a Topic"),
    *((f"class Reader(Actor):\n    @every{period}\n    def tick(self): pass\n",
       "ValueError: @every(") for period in ("(0)", "")),
])
def test_a_handler_that_would_never_run(tank, code, cause):
    line = line_of(tank, code, "Reader")
    assert line.startswith(
        f"node reader: actor = 'tank_here:Reader': tank_here cannot be imported: {cause}")
    assert "/tank_here.py, line " in line


def test_an_actor_of_the_wrong_kind(tank):
    assert line_of(tank, "", "Gauge", kind="manager").startswith(
        "node gauge: actor = 'tank_here:Gauge': it does not publish manager/status, as the manager "
        "does")
    module = ("from rampart.actors.detection.stub import StubDetection\n"
              "class Detects(StubDetection): pass\n"
              "class World(Gauge):\n    node_kind = 'world'\n")
    assert line_of(tank, module, "Detects") == (
        "node detects: actor = 'tank_here:Detects': it publishes detection/{name}, so it belongs "
        "in [[detection]]")
    assert line_of(tank, module, "World", kind="pilot") == (
        "node world: actor = 'tank_here:World': not a pilot node, expected kind = 'world'")
    assert "world" in tank(module, "World", kind="world").members


@pytest.mark.parametrize(("said", "line"), [
    ("", "$.judge.class: missing; expected a class derived from rampart.Judge"),
    ('class = "tank_here:Fiar"\n', "$.judge.class = 'tank_here:Fiar': no such judge class"),
    ('class = "tank_here:Pump"\n', "$.judge.class = 'tank_here:Pump': expected a class derived"),
    ('class = "tank_here:Fair"\nlitres = 3\n', "$.judge.litres = 3: unknown field; known: none"),
    ('class = "tank_here:Fair"\n', "$.judge: Fair hears 'tank/levle', which nothing publishes; "),
])
def test_a_judge_that_cannot_judge(tank, said, line):
    more = f"[judge]\n{said or 'litres = 3'}"
    assert line_of(tank, JUDGE.format("LEVLE"), "Gauge", more=more).startswith(line)


# -- parameters


FILE = "osmosis.toml"
PLAN = RunPlan(seed=5, system_file=FILE)
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


def said(table: str, name: str, **parameters) -> SystemSpec:
    """The full system with other parameters of one module."""
    rows = tuple(msgspec.structs.replace(row, parameters={**row.parameters, **parameters})
                 if row.name == name else row for row in getattr(FULL_SPEC, table))
    return msgspec.structs.replace(FULL_SPEC, **{table: rows})


def refusal(spec: SystemSpec) -> str:
    with pytest.raises(SpecificationError) as caught:
        Layout(PLAN, spec)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_what_plan_and_spec_say_is_given_to_the_actors_that_take_it():
    members = Layout(PLAN, said("nodes", "simulator", obstacles=1)).members
    assert members["RM4"].parameters.nodes == ("localization", "hmi", "teleoperation")
    world = members["simulator"].parameters
    assert (world.seed, world.obstacles, world.dead_man, world.upper_laser) == (5, 1, True, True)
    rows = tuple(msgspec.structs.replace(row, actor="rampart.actors.recovery.stub:StubRecovery")
                 if row.name == "RM4" else row for row in FULL_SPEC.recoveries)
    members = Layout(PLAN, msgspec.structs.replace(FULL_SPEC, recoveries=rows)).members
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
