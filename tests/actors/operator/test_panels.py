"""Panels that a specification or a page's class declares: checked at load, heard, and bounded."""

from __future__ import annotations

import asyncio
import dataclasses
import json
import math
import re
from contextlib import asynccontextmanager
from pathlib import Path

import msgspec
import pytest

from rampart.actors.bus.fields import StickMessages
from rampart.actors.bus.messages import Message
from rampart.actors.bus.topic import Qos, Topic
from rampart.actors.operator.hmi import Hmi
from rampart.actors.operator.panels import MAX_KEPT, MAX_PANELS, Panel
from rampart.actors.operator.server import page_files
from rampart.actors.operator.state import HmiState
from rampart.actors.osmosis.page.hmi import OsmosisHmi
from rampart.actors.runtime.actor import Actor, Header, on
from rampart.actors.runtime.run_plan import RunPlan
from rampart.actors.system.layout import Layout
from rampart.actors.system.members import published
from rampart.manager.spec.specification import parse_specification
from rampart.testing import eventually
from tests import ROOT, TANK
from tests.actors.operator.test_operating import Hand as Driver
from tests.actors.operator.world import Others, ask, hear, open_page, served
from tests.tank import GAUGE, HAND, LEVEL, PUMP, TOPICS, VALVE, Hand, Level, Phase, Pump

WORKS = """
[[node]]
name = "pump"
actor = "tests.actors.operator.test_panels:Works"
kind = "control"
"""
PAGE = """
[[node]]
name = "page"
actor = "rampart.actors.operator.hmi:Hmi"
kind = "non-control"
"""


class Works(Actor):
    """Publishes what there is to show."""

    outputs = (LEVEL, PUMP, VALVE, GAUGE)


class Speaks(Others):
    """Says what the tests want."""

    outputs = (*Others.outputs, LEVEL, PUMP, VALVE)


class OwnHmi(Hmi):
    """A page with a panel of its class."""

    panels = (Panel(title="Own", gauge="tank/level:height_m", max=3.0),)


def layout(panels: str = "", page: str = PAGE) -> Layout:
    return Layout(RunPlan(system_file="tank.toml"),
                  parse_specification(TANK + WORKS + page + panels, "tank.toml"))


def shown(found: Layout) -> list[tuple[str, str]]:
    return [(p.title, p.kind) for p in found.members["page"].parameters.panels]


def panel(title: str, rest: str) -> str:
    return f'[[panel]]\ntitle = "{title}"\n{rest}\n'


# ---- at load ------------------------------------------------------------------------------------


def test_the_page_hears_what_the_panels_of_class_and_specification_show():
    found = layout(panel("Pump", 'states = "tank/pump:phase"\nof = ["idle", "filling"]'),
                   PAGE.replace("rampart.actors.operator.hmi:Hmi", f"{__name__}:OwnHmi"))
    assert shown(found) == [("Own", "gauge"), ("Pump", "states")]
    assert found.topics == {"tank/level": LEVEL, "tank/pump": PUMP}
    assert found.members["page"].hears.keys() == {"tank/level", "tank/pump"}


def test_a_page_without_panels_plots_the_numbers_of_what_comes_regularly():
    found = layout()
    plots = found.members["page"].parameters.panels
    assert [(p.title, p.plot) for p in plots] == [
        ("tank/level m", ("tank/level:height_m",)),
        ("tank/level rad", ("tank/level:heading_rad",)),
        ("tank/pump s", ("tank/pump:busy_until_s",)), ("tank/valve", ("tank/valve:opening",))]


def test_the_examples_of_the_document_are_sound(tmp_path):
    document = (ROOT / "docs/how-to/operator-page.md").read_text("utf-8")
    toml, python = (re.findall(rf"```{kind}\n(.*?)```", document, re.DOTALL)[0]
                    for kind in ("toml", "python"))
    assert shown(layout(toml)) == [
        ("Level", "gauge"), ("Level over time", "plot"), ("Pump", "states")]
    assert [line for line in [str(caught(toml.replace("phase", "phse")))] if line in document]
    (tmp_path / "page").mkdir()
    (tmp_path / "page" / "pipes.js").write_text("export default class {}")
    made: dict = {"__file__": str(tmp_path / "tank.py"), "__name__": "tank"}
    exec(python, made)
    assert [p.kind for p in made["TankPage"].panels] == ["gauge", "script"]
    assert "/robot/pipes.js" in page_files(made["TankPage"].files)


def caught(*texts: str) -> ValueError:
    with pytest.raises(ValueError, match=r".") as found:
        layout(*texts)
    return found.value


MANY = "".join(panel(f"P{i}", 'text = "tank/level:height_m"') for i in range(MAX_PANELS + 1))
PLOTS = "".join(panel(f"P{i}", f'plot = {["tank/level:height_m"] * 8}') for i in range(5))


@pytest.mark.parametrize(("panels", "words"), [
    ('gauge = "tank/levle:height_m"', "no actor has a topic 'tank/levle'; the nearest: tank/level"),
    ('plot = ["tank/level:height_m", "tank/level:hieght_m"]', "did you mean height_m?"),
    ('gauge = "tank/pump:phase"', "topic tank/pump: phase is a text; expected a number"),
    ('states = "tank/level:height_m"', "height_m is a number; expected a text or a truth"),
    ('script = "map.js"', ".script = 'map.js': 'Level': only the class of a page has scripts"),
    ('gauge = "a:b"\ntext = "a:b"', "'Level' has gauge and text; expected one of "),
    ('gauge = "a:b"\nseconds = 3', "seconds does not apply to a gauge; it takes max, min, unit"),
    ('gauge = "a:b"\nmin = 2', "'Level': min = 2 is not below max = 1"),
    ('map = ["a:x", "a:y"]\nextent_m = [0, 0, 0, 1]', "'Level': extent_m: expected x0, y0"),
    (panel("Level", 'gauge = "tank/level:height_m"') * 2, "two panels have this title"),
    (PLOTS, f"40 fields in plots and maps; expected at most {MAX_KEPT} together"),
    (MANY, f"$.panel: {MAX_PANELS + 1} panels; expected at most {MAX_PANELS}"),
])
def test_a_panel_that_cannot_be_is_refused_in_one_line(panels, words):
    said = str(caught(panels if "[[panel]]" in panels else panel("Level", panels)))
    assert said.startswith("tank.toml: ")
    assert words in said
    assert "\n" not in said


def test_panels_that_no_node_shows_are_refused():
    with pytest.raises(ValueError, match=r"^tank.toml: \$.panel: no node takes it; "
                                         r"expected a node with actor = 'rampart\.\S+:Hmi'\Z"):
        layout(panel("Level", 'gauge = "tank/level:height_m"'), "")


def test_a_script_that_is_not_there_is_noticed_when_the_class_is_made():
    with pytest.raises(ValueError, match=r"panel 'Map': script = 'nothing.js': expected a file in "
                                         r"Wrong.files = '.*files'"):
        type("Wrong", (Hmi,), {"files": OsmosisHmi.files,
                               "panels": (Panel(title="Map", script="nothing.js"),)})


# ---- what is heard ------------------------------------------------------------------------------


PANELS = (Panel(title="Level", gauge="tank/level:height_m"),
          Panel(title="Over time", plot=("tank/level:height_m", "tank/pump:running"), seconds=600),
          Panel(title="Pump", states="tank/pump:phase"),
          Panel(title="All", table=("tank/level:cells[max]", "tank/valve:shut")),
          Panel(title="Rule", text="manager/status:strategy"))


def hmi(world, panels=PANELS, kind: type[Hmi] = Hmi) -> Hmi:
    from rampart.actors.ftm import topics

    known = {t.key: t for t in (*TOPICS, *topics.ALL)}
    return kind(dataclasses.replace(
        world.context("hmi", 1), topics=known,
        parameters={"panels": panels}))


async def test_the_latest_value_of_each_field_is_shown_and_what_was_plotted_lately(world):
    world.others = Speaks(world.context("speaks", 1))
    async with world.running(world.others), world.running(hmi(world)) as page:
        picture = page._state.picture
        for height in (0.1, 0.2, 0.3):
            world.others.publish(LEVEL, Level(height, (1.0, height)))
            await eventually(lambda h=height: (v := picture.value("tank/level:height_m"))
                             is not None and v.value == h)
        world.others.publish(PUMP, Pump(Phase.FILLING))
        world.say_latched("RM1")
        await eventually(lambda: picture.value("tank/pump:phase") is not None
                         and picture.value("manager/status:strategy") is not None)
        assert page._state.latched == ("RM1",)  # the page's own handler hears it too
        now = json.loads(msgspec.json.encode(picture.changes(0)))
        assert now["tank/level:cells[max]"] == {"value": 1.0, "stale": False, "t": 0.0}
        assert now["tank/valve:shut"] is None
        assert (now["tank/level:height_m"]["value"], now["tank/pump:phase"]["value"],
                now["manager/status:strategy"]["value"]) == (0.3, "filling", "safety-first")
        past = page._hello()["past"]
        assert past["tank/level:height_m"][0][1] == 0.1
        assert past.keys() == {"tank/level:height_m", "tank/pump:running"}


async def test_a_field_that_is_not_known_is_said_and_the_rest_is_shown(world):
    strange = (Panel(title="Strange", text="no/topic:x"), *PANELS)
    async with world.running(hmi(world, strange)) as page:
        await eventually(lambda: any(d.context == "panel" for d in world.others.diagnostics))
        assert "hmi: unknown topic 'no/topic'" in {d.reason for d in world.others.diagnostics}
        assert page._hello()["panels"][0]["title"] == "Strange"


def test_a_field_is_stale_by_the_rate_of_its_topic():
    state = HmiState()
    state.show_field("slow:x", 0.0, 30.0)
    state.show_field("event:x", 0.0, math.inf)
    for name in ("slow:x", "event:x"):
        state.field(name, "a text", 0.0, 0.0)
    state.grow_old(29.0)
    assert not state.picture.value("slow:x").stale
    state.grow_old(1e6)
    assert state.picture.value("slow:x").stale
    assert not state.picture.value("event:x").stale


# ---- what is served -----------------------------------------------------------------------------


def test_a_robot_s_files_are_served_beside_the_page_s_which_know_no_robot():
    plain, own = page_files(None), page_files(OsmosisHmi.files)
    assert own.keys() - plain.keys() == {
        f"/robot/{file.name}" for file in Path(OsmosisHmi.files).iterdir()}
    head = own["/"].content.decode()
    for link in ('<link rel="stylesheet" href="robot/osmosis.css">',
                 '<link rel="modulepreload" href="robot/map.js">',
                 '<link rel="modulepreload" href="app.js">'):
        assert link in head
    words = ("airport", "lights", "mission", "runway", "osmosis")
    for path, file in plain.items():
        text = file.content.decode().lower()
        assert [word for word in words if word in text] == [], path


# -- A stick that is declared: checked at load, and told to the robot while it is held --


FIELDS = 'stick = ["tank/hand:forward", "tank/hand:left"]'
DRIVE = Panel(title="Drive", stick=("tank/hand:forward", "tank/hand:left"), held="tank/hand:held",
              scale=(0.5, -4.0))
AT_REST = Hand(0.0)


class Place(Message):
    """A number within."""

    at: Hand = AT_REST
    count: int = 0


PLACE = Topic("tank/place/{name}", Place, Qos.COMMAND, 0.0, "", "Where each of some is to go.")


class Driven(Actor):
    """Obeys the stick."""

    @on(HAND)
    def hand(self, message: Hand, _header: Header) -> None:
        pass

    @on(PLACE)
    def place(self, message: Place, _header: Header) -> None:
        pass

    optional_inputs = (PLACE, HAND)


class Needs(Driven):
    """Cannot do without the stick."""

    optional_inputs = (PLACE,)


class Rival(Actor):
    """Says what the operator says."""

    outputs = (HAND,)


class Commands(Actor):
    """Commands one of those that the operator commands."""

    outputs = (PLACE,)

    @classmethod
    def output_names(cls, _topic, _name, _parameters):
        return ("b",)


class StickHmi(Hmi):
    """A page that brings its stick along."""

    panels = (Panel(title="Hand", stick=("tank/hand:forward",)),)


def node(kind: str) -> str:
    return f'[[node]]\nname = "{kind.lower()}"\nactor = "{__name__}:{kind}"\nkind = "control"\n'


def texts(rest: str, *nodes: str, page: str = PAGE) -> tuple[str, str]:
    return panel("Drive", rest) if rest else "", page + "".join(map(node, nodes))


def refused(rest: str, *nodes: str, **page: str) -> str:
    return str(caught(*texts(rest, *nodes, **page)))


# ---- at load ------------------------------------------------------------------------------------


def test_the_page_publishes_what_its_stick_says_and_does_not_hear_it():
    document = (ROOT / "docs/how-to/operator-page.md").read_text("utf-8")
    toml = re.findall(r"```toml\n(.*?)```", document.partition("### Add a joystick")[2], re.DOTALL)
    found = layout(toml[0].replace("tug/stick", "tank/hand"), PAGE + node("Needs"))
    page = found.members["page"]
    assert [p.stick for p in page.parameters.panels] == [DRIVE.stick]
    assert "tank/hand" in published(page)
    assert page.hears == {}
    assert found.topics == {"tank/hand": HAND}


def test_a_stick_of_the_page_s_class_or_of_a_member_of_a_family_has_its_topic_alone():
    own = PAGE.replace("rampart.actors.operator.hmi:Hmi", f"{__name__}:StickHmi")
    assert "tank/hand" in published(layout(*texts("", "Needs", page=own)).members["page"])
    assert refused("", "Driven", "Rival", page=own).startswith(
        "tank.toml: page: panel 'Hand': stick: node rival publishes 'tank/hand' as well, and may "
        "move what an operator let go")
    assert refused(FIELDS, "Driven", page=own) == (
        "tank.toml: page: panel 'Hand': another stick publishes tank/hand too; expected one")
    found = layout(*texts('stick = ["tank/place/a:count"]', "Driven", "Commands"))
    assert published(found.members["page"])["tank/place/{name}"] == ("a",)
    assert "node commands publishes 'tank/place/b' as well, and may move what" in refused(
        'stick = ["tank/place/b:count"]', "Driven", "Commands")


@pytest.mark.parametrize(("rest", "words"), [
    ('stick = ["tank/hand:forwards"]', "has no field 'forwards'; did you mean forward?"),
    ('stick = ["tank/hand:held"]', "topic tank/hand: held is a truth; expected a number"),
    (f'{FIELDS}\nheld = "tank/hand:left"', "tank/hand:left: expected each field once"),
    ('stick = ["tank/hand:forward"]\nheld = "tank/hand:left"',
     "held: topic tank/hand: left is a number; expected a truth"),
    ('stick = ["tank/hand:forward", "tank/level:height_m"]',
     "fields of tank/hand and tank/level; expected fields of one topic"),
    (f"{FIELDS}\nscale = [1.0]", "scale = [1.0]: expected one number for each of tank/hand:forwar"),
    (f"{FIELDS}\nscale = [1.0, 0.0]", "expected numbers other than 0, at most 1e+09"),
    (f"{FIELDS}\nseconds = 3", "seconds does not apply to a stick; it takes held, scale"),
    ('stick = ["tank/pump:busy_until_s"]', "no value for phase; expected a default in its class"),
    ('stick = ["tank/place/a:at.forward"]', "at.forward: not a field of Place; expected one of at"),
    (f"{FIELDS}\nscale = [1.0, 1.0]", "forward = -1 at full deflection: Expected `float` >= -0.5"),
])
def test_a_stick_that_cannot_be_is_refused_in_one_line(rest, words):
    said = refused(rest, "Driven")
    assert words in said
    assert said.startswith("tank.toml: ")
    assert "\n" not in said


# ---- its messages -------------------------------------------------------------------------------


def test_a_number_goes_from_bound_to_bound_and_is_0_at_rest():
    said = StickMessages(Hand, ("forward", "left"), "held")
    assert said((1.0, 1.0)) == Hand(2.0, 1.0, True)
    assert said((-1.0, -1.0)) == Hand(-0.5, -1.0, True)
    assert said((0.5, 0.0)) == Hand(1.0, 0.0, True)
    assert said(None) == Hand(0.0, 0.0, False)
    turned = StickMessages(Hand, ("left", "forward"), "", (-4.0, 0.5))
    assert turned((0.5, 1.0)) == Hand(0.5, -2.0)
    assert math.copysign(1.0, turned(None).left) == 1.0


# ---- while somebody holds it --------------------------------------------------------------------


class Robot(Speaks):
    """Hears the stick."""

    outputs = (*Speaks.outputs, LEVEL, PUMP)

    def __init__(self, context) -> None:
        super().__init__(context)
        self.hands: list[Hand] = []

    @on(HAND)
    def hand(self, message: Hand, _header: Header) -> None:
        self.hands.append(message)


@asynccontextmanager
async def driven(world, *panels: Panel):
    """A page with a stick, and a robot that hears it."""
    robot = Robot(world.context("robot", 1))
    async with world.running(robot), world.running(hmi(world, panels or (DRIVE,))) as page:
        yield robot, page, await served(page)


async def rests(robot: Robot) -> None:
    """Wait until the robot is told to rest, and see that it is told nothing more."""
    await eventually(lambda: bool(robot.hands) and robot.hands[-1] == AT_REST)
    count = len(robot.hands)
    await asyncio.sleep(0.1)
    assert len(robot.hands) == count


@pytest.mark.usefixtures("patient")
async def test_it_is_told_again_and_again_while_it_is_held_and_at_rest_once(world):
    async with driven(world) as (robot, _, at):
        await eventually(lambda: robot.hands == [AT_REST])  # a former incarnation may have driven
        async with open_page(at) as page:
            hand = Driver(page)
            await hand.take()
            await hand.hold(0.5, 0.25)
            count = len(robot.hands)
            await eventually(lambda: len(robot.hands) >= count + 5)
            assert robot.hands[-1] == Hand(0.25, -1.0, True)
            await ask(page, type="stick", panel="Drive", held=False)
            await rests(robot)
    assert robot.hands.count(AT_REST) == 2


@pytest.mark.usefixtures("patient")
async def test_what_is_no_message_of_this_stick_moves_nothing(world):
    async with driven(world) as (robot, _, at):
        async with open_page(at) as page:
            told = await ask(page, type="stick", panel="Drvie", held=True)
            assert told == {"type": "error", "text": "no stick 'Drvie'; known: Drive"}
            for wrong in ('"forward":NaN', '"forward":1e999', '"left":"x"', '"forward":[1]',
                          '"forward":-1e308', '"extra":1'):
                await page.send(f'{{"type":"stick","panel":"Drive","held":true,{wrong}}}')
                assert "not understood" in (await hear(page, "error"))["text"]
    assert set(robot.hands) <= {AT_REST}


@pytest.mark.usefixtures("patient")
async def test_two_sticks_are_held_by_two_pages_and_each_by_one(world):
    place = Panel(title="Place", stick=("tank/hand:forward",))
    level = Panel(title="Level", stick=("tank/level:height_m",), scale=(3.0,))
    async with driven(world, place, level) as (robot, _, at):
        async with open_page(at) as one, open_page(at) as two:
            await Driver(one, "Level").take()
            other = Driver(two, "Level")
            await other.hold()
            assert "page 1 has the stick" in (await other.hold())["text"]
            await Driver(two, "Place").take()
            shown = (await hear(two, "state"))["operating"]["sticks"]
            while not all(stick["holder"] for stick in shown.values()):
                shown = (await hear(two, "state"))["operating"]["sticks"]
            assert {name: stick["holder"] for name, stick in shown.items()} == {
                "Place": 2, "Level": 1}
        await eventually(lambda: robot.hands[-1] == AT_REST)
