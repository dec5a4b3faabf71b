"""Connections of a system's actors are checked before a run, and errors are one line."""

import importlib
import sys
import textwrap

import pytest

from rampart.actors.runtime.run_plan import RunPlan, load_system
from rampart.actors.system.layout import Layout
from tests import system_file

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
