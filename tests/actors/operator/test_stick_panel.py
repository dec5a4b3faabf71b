"""A stick that is declared: checked at load, and told to the robot while it is held."""

from __future__ import annotations

import asyncio
import math
import re
from contextlib import asynccontextmanager

import pytest

from rampart.actors.bus.fields import StickMessages
from rampart.actors.bus.messages import Message
from rampart.actors.bus.topic import Qos, Topic
from rampart.actors.operator.hmi import Hmi
from rampart.actors.operator.panels import Panel
from rampart.actors.runtime.actor import Actor, Header, on
from rampart.actors.system.layout import Layout
from rampart.actors.system.members import published
from rampart.testing import eventually
from tests import ROOT
from tests.actors.operator.test_operating import Hand as Driver
from tests.actors.operator.test_panels import PAGE, Speaks, hmi, layout, panel
from tests.actors.operator.world import ask, hear, open_page, served
from tests.tank import HAND, LEVEL, PUMP, Hand

FIELDS = 'stick = ["tank/hand:forward", "tank/hand:left"]'
HELD = 'held = "tank/hand:held"'
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


class OwnHmi(Hmi):
    """A page that brings its stick along."""

    panels = (Panel(title="Hand", stick=("tank/hand:forward",)),)


def node(kind: str) -> str:
    return f'[[node]]\nname = "{kind.lower()}"\nactor = "{__name__}:{kind}"\nkind = "control"\n'


def laid_out(rest: str, *nodes: str, page: str = PAGE) -> Layout:
    return layout(panel("Drive", rest) if rest else "", page + "".join(map(node, nodes)))


def refused(rest: str, *nodes: str, **page: str) -> str:
    with pytest.raises(ValueError, match=r".") as caught:
        laid_out(rest, *nodes, **page)
    return str(caught.value)


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
    own = PAGE.replace("rampart.actors.operator.hmi:Hmi", f"{__name__}:OwnHmi")
    assert "tank/hand" in published(laid_out("", "Needs", page=own).members["page"])
    assert refused("", "Driven", "Rival", page=own).startswith(
        "tank.toml: page: panel 'Hand': stick: node rival publishes 'tank/hand' as well, and may "
        "move what an operator let go")
    assert refused(FIELDS, "Driven", page=own) == (
        "tank.toml: page: panel 'Hand': another stick publishes tank/hand too; expected one")
    found = laid_out('stick = ["tank/place/a:count"]', "Driven", "Commands")
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
