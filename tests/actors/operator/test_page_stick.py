"""A declared stick in a real Chromium: by mouse, by key, let go, lost, taken by another page."""

from __future__ import annotations

from contextlib import asynccontextmanager

import pytest

from rampart.actors.operator.panels import Panel
from rampart.testing import eventually
from tests.actors.operator.browser import browser, mouse
from tests.actors.operator.page import LIVE
from tests.actors.operator.test_page_operating import hand_on_the_pad, key
from tests.actors.operator.test_stick_panel import AT_REST, DRIVE, driven, rests
from tests.tank import Hand

pytestmark = [pytest.mark.page, pytest.mark.usefixtures("patient")]

LIFT = Panel(title="Lift", stick=("tank/level:height_m",), scale=(3.0,))


def of(panel: str, part: str) -> str:
    return f"document.querySelector('[data-name=\"{panel}\"] {part}')"


def state(panel: str = "Drive") -> str:
    return f"{of(panel, '.stick-state')}.textContent"


@asynccontextmanager
async def opened(at: str, **look):
    async with browser() as tab:
        await tab.show(f"http://{at}/", **look)
        await tab.until(f"{LIVE} && {state()} === 'free'")
        yield tab
        assert tab.errors == []


async def is_told(robot, hand: Hand) -> None:
    await eventually(lambda: robot.hands[-1] == hand)


async def test_by_mouse_and_by_key_the_robot_is_told_while_it_is_held(world):
    async with driven(world) as (robot, _, at), opened(at) as tab:
        await tab.value(f"{of('Drive', '.stick')}.scrollIntoView({{block: 'center'}})")
        x, y, radius = await hand_on_the_pad(tab)
        await mouse(tab, "mousePressed", x, y)
        await mouse(tab, "mouseMoved", x, y - 2 * radius)
        await is_told(robot, Hand(0.25, 0.0, True))  # at half speed
        await tab.until(f"{state()} === 'you drive'")
        await mouse(tab, "mouseMoved", x + 2 * radius, y)
        await is_told(robot, Hand(0.0, 2.0, True))
        await mouse(tab, "mouseReleased", x + 2 * radius, y)
        await rests(robot)

        await tab.value(f"{of('Drive', '.stick')}.focus()")
        await tab.value(f"{of('Drive', '.stick-words input')}.value = 100")
        await key(tab, "w", down=True)
        await is_told(robot, Hand(0.5, 0.0, True))
        await key(tab, "ArrowLeft", down=True)
        await is_told(robot, Hand(0.5, -4.0, True))
        await key(tab, "w", down=False)
        await is_told(robot, Hand(0.0, -4.0, True))
        await key(tab, "ArrowLeft", down=False)
        await rests(robot)
        await tab.until(f"{state()} === 'free'")


async def test_a_page_that_is_closed_while_it_is_held_has_let_go(world):
    async with driven(world) as (robot, _, at), opened(at) as tab:
        await tab.value(f"{of('Drive', '.stick')}.focus()")
        await key(tab, "s", down=True)
        await is_told(robot, Hand(-0.25, 0.0, True))
        await tab.call("Page.navigate", url="about:blank")
        await rests(robot)


async def test_of_two_pages_one_drives_and_the_other_is_told(world):
    async with driven(world) as (robot, _, at), opened(at) as one, opened(at) as two:
        for tab in (one, two):
            await tab.value(f"{of('Drive', '.stick')}.focus()")
        await key(one, "w", down=True)
        await is_told(robot, Hand(0.25, 0.0, True))
        await two.until(f"{state()} === 'page 1 drives'")
        await key(two, "s", down=True)
        await two.until(f"{of('Drive', '.stick-text')}.textContent.includes("
                        "'page 1 has the stick')")
        await key(one, "w", down=False)
        await rests(robot)  # the other one, too, has to let go first
        await key(two, "s", down=False)
        await key(two, "s", down=True)
        await is_told(robot, Hand(-0.25, 0.0, True))
        await key(two, "s", down=False)
        await rests(robot)
    assert all(hand.forward in (0.0, 0.25, -0.25) for hand in robot.hands)


async def test_of_two_sticks_each_has_its_keys_and_the_gamepad_is_the_first_one_s(world):
    async with driven(world, DRIVE, LIFT) as (robot, page, at), opened(at) as tab:
        how = await tab.value(f"{of('Lift', '.stick-words')}.textContent")
        assert "click it and hold the up or down key, W or S. Letting go stops." in how
        await tab.value(f"{of('Lift', '.stick')}.focus()")
        await key(tab, "a", down=True)
        await rests(robot)
        assert await tab.value(state("Lift")) == "free"  # it has no such direction
        await key(tab, "w", down=True)
        await tab.until(f"{state('Lift')} === 'you drive'")
        assert page._operating._sticks["Lift"].desk.holder == 1
        assert robot.hands == [AT_REST]
        await key(tab, "w", down=False)
        await tab.value(
            "navigator.getGamepads = () => [{connected: true, axes: [0, -1], buttons:"
            " Array.from({length: 8}, (_, i) => ({pressed: window.held && i === 4}))}];"
            "dispatchEvent(new Event('gamepadconnected')); window.held = true")
        await is_told(robot, Hand(0.25, 0.0, True))
        assert await tab.value(state("Lift")) == "free"
        await tab.value("window.held = false")
        await rests(robot)


async def test_on_a_phone_a_stick_has_room(world):
    async with driven(world, DRIVE, LIFT) as (_, _, at), opened(at, width=360, height=740) as tab:
        assert await tab.value("document.documentElement.scrollWidth") == 360
