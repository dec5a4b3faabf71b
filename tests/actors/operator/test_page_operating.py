"""The operator's hands in a real browser: dead man, two operators, signals, strategy, faults."""

from __future__ import annotations

import asyncio
import json

import pytest

from rampart.actors.bus import messages as bm
from rampart.actors.bus import topics as bus_topics
from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.sim.osmosis.trial.faults import OsmosisFaults
from rampart.testing import eventually, free_port
from tests.actors.operator.browser import browser, mouse
from tests.actors.operator.test_operating import RELEASED
from tests.actors.operator.world import LIVE, World, repeated, show
from tests.osmosis_system import shipped_system

pytestmark = pytest.mark.page

FREE = "$('.stick-state').textContent === 'free'"
WORDS = "$('.stick-text').textContent"
PAD = "$('.stick')"


def alive(world: World):
    """Have the Safety Pilot and the manager heard, as in a run in which all is well."""
    def say() -> None:
        world.others.publish(topics.PILOT_STATUS, m.PilotStatus(m.PilotMode.AUTO, False, "", 0))
        world.others.publish(ftm_topics.MANAGER_STATUS, fm.ManagerStatus(
            (), (), (), (), "safety-first", 0))
    return repeated(say)


@pytest.fixture
async def tab(world, hmi, tab):
    """The page of an HMI in a run in which all is well."""
    async with alive(world):
        await show(tab, hmi)
        await tab.until(FREE)
        yield tab


async def key(tab, name: str, *, down: bool, repeat: bool = False, modifiers: int = 0) -> None:
    await tab.call("Input.dispatchKeyEvent", type="rawKeyDown" if down else "keyUp", key=name,
                   code=f"Key{name.upper()}" if len(name) == 1 else name,
                   autoRepeat=repeat, modifiers=modifiers)


def moved(world) -> bool:
    return any(stick != RELEASED for stick in world.others.stick)


async def hand_on_the_pad(tab, pad: str = PAD) -> tuple[float, float, float]:
    """Give the middle of a pad and its radius, when nothing moves it any more."""
    where = (f"(() => {{ const b = {pad}.getBoundingClientRect(); return JSON.stringify("
             "[b.left + b.width / 2, b.top + b.height / 2, b.width / 2]); })()")
    last, seen = None, await tab.value(where)
    while seen != last:
        x, y, radius = json.loads(seen)
        await mouse(tab, "mouseMoved", x, y)
        last, seen = seen, await tab.value(where)
    return x, y, radius


async def drives(tab, world, **position: float) -> None:
    """Wait until the robot is told to drive like this."""
    wanted = m.Joystick(position.get("forward", 0.0), position.get("left", 0.0), dead_man=True)
    await eventually(lambda: bool(world.others.stick) and world.others.stick[-1] == wanted)
    await tab.until("$('.stick-state').textContent === 'you drive'")


async def drive_ahead(tab, world) -> None:
    """Hold the key W on the stick of the page."""
    await tab.value(f"{PAD}.focus()")
    await key(tab, "w", down=True)
    await drives(tab, world, forward=0.5)


async def stops(world) -> None:
    await eventually(lambda: world.others.stick[-1] == RELEASED)
    count = len(world.others.stick)
    await asyncio.sleep(0.15)  # three periods of a page that would go on
    assert len(world.others.stick) == count


@pytest.mark.usefixtures("patient")
async def test_the_keyboard_drives_while_a_key_is_held_and_everything_else_stops(world, tab):
    await key(tab, "ArrowUp", down=True)
    await asyncio.sleep(0.15)
    assert not moved(world)  # only with the focus on the stick
    await key(tab, "ArrowUp", down=False)

    await tab.value(f"{PAD}.focus()")
    await key(tab, "ArrowUp", down=True)
    await drives(tab, world, forward=0.5)
    await key(tab, "a", down=True)
    await drives(tab, world, forward=0.5, left=0.5)
    await key(tab, "ArrowUp", down=False)
    await drives(tab, world, left=0.5)
    await key(tab, "a", down=False)
    await stops(world)

    for lost in (f"{PAD}.blur()", "dispatchEvent(new Event('blur'))",
                 "Object.defineProperty(document, 'hidden', {value: true, configurable: true});"
                 "document.dispatchEvent(new Event('visibilitychange'));delete document.hidden"):
        await tab.value(f"{PAD}.focus()")
        await key(tab, "ArrowDown", down=True)
        await drives(tab, world, forward=-0.5)
        await tab.value(lost)
        await stops(world)
        await tab.value(f"{PAD}.focus()")
        await key(tab, "ArrowDown", down=True, repeat=True)  # held since before
        await stops(world)
        await key(tab, "ArrowDown", down=False)

    for name, held in (("Alt", 1), ("Control", 2), ("Meta", 4)):  # a key let go under another one
        await drive_ahead(tab, world)
        await key(tab, f"{name}Left", down=True, modifiers=held)
        await stops(world)
        await key(tab, "w", down=False, modifiers=held)
        await key(tab, f"{name}Left", down=False)
        await stops(world)

    await drive_ahead(tab, world)
    world.others.publish(bus_topics.DIAGNOSTIC, bm.Diagnostic(
        "teleoperation", "joystick", "not followed: /dev/input/js0 has the stick", "hmi", 1))
    await tab.until("$('.stick-state').textContent === 'not followed'")
    assert "/dev/input/js0 has the stick" in await tab.value(WORDS)
    await key(tab, "w", down=False)
    await stops(world)


async def test_a_page_that_hangs_has_let_go_and_is_to_press_again(world, tab):
    await drive_ahead(tab, world)
    await tab.value("{ const end = Date.now() + 700; while (Date.now() < end); }")
    await tab.until(f"{WORDS}.includes('let go first, then press again')")
    await stops(world)
    await key(tab, "w", down=False)
    await tab.until(FREE)
    await key(tab, "w", down=True)
    await drives(tab, world, forward=0.5)
    await tab.call("Page.navigate", url="about:blank")
    await stops(world)


@pytest.mark.usefixtures("patient")
async def test_an_hmi_that_comes_back_is_not_driven_by_a_key_that_is_still_held(world):
    port = free_port()
    async with browser() as tab, alive(world):
        async with world.hmi(hmi_port=port) as hmi:
            await show(tab, hmi)
            await tab.until(FREE)
            await tab.value(f"{PAD}.focus()")
            await key(tab, "ArrowUp", down=True)
            await drives(tab, world, forward=0.5)
        await stops(world)
        async with world.hmi(incarnation=2, hmi_port=port):
            await tab.until(FREE)
            await key(tab, "ArrowUp", down=True, repeat=True)
            await tab.until(f"{WORDS}.includes('let go first, then press again')")
            await stops(world)
            await key(tab, "ArrowUp", down=False)
            await key(tab, "ArrowUp", down=True)
            await drives(tab, world, forward=0.5)
        await key(tab, "ArrowUp", down=False)
        await tab.until("document.body.classList.contains('offline')")
        await key(tab, "ArrowUp", down=True)  # pressed while nobody listens
        async with world.hmi(incarnation=3, hmi_port=port):
            await tab.until(LIVE)
            await key(tab, "ArrowUp", down=True, repeat=True)
            await tab.until(f"{WORDS}.includes('let go first, then press again')")
            await stops(world)


@pytest.mark.usefixtures("patient")
async def test_the_stick_on_the_screen_and_a_gamepad_drive(world, tab):
    await tab.value(f"{PAD}.scrollIntoView({{block: 'center'}})")
    await tab.value("$('.stick-words input').value = 100")
    x, y, radius = await hand_on_the_pad(tab)
    await mouse(tab, "mousePressed", x, y)
    await mouse(tab, "mouseMoved", x, y - 3 * radius)  # outside: full ahead, no more
    await drives(tab, world, forward=1.0)
    await mouse(tab, "mouseReleased", x, y - 3 * radius)
    await stops(world)

    held = "window.pad.buttons[4].pressed"
    await tab.value(
        "window.pad = {connected: true, axes: [0.5, 0.05], buttons: Array.from({length: 8},"
        " () => ({pressed: false}))}; navigator.getGamepads = () => [window.pad];"
        " dispatchEvent(new Event('gamepadconnected'))")
    await stops(world)  # moved, but the dead man is not held
    for end in (f"{held} = false", "window.pad.connected = false;"
                " dispatchEvent(new Event('gamepaddisconnected'))"):
        await tab.value(f"{held} = true")
        await drives(tab, world, left=-0.5)
        await tab.value(end)
        await stops(world)
    await tab.value("window.pad.connected = true; dispatchEvent(new Event('gamepadconnected'))")
    await stops(world)  # plugging in moves nothing
    await tab.value(f"{held} = false")
    await asyncio.sleep(0.15)
    await tab.value(f"document.hasFocus = () => false; {held} = true")
    await stops(world)  # meant for another window


@pytest.mark.parametrize("hmi", [{"launcher_pid": 1, "faults": OsmosisFaults().offered(),
                                  "system": shipped_system()}], indirect=True)
async def test_a_node_is_signalled_by_a_second_press_a_strategy_chosen_and_a_fault_injected(
        world, tab, signalled):
    row = "$('tr[data-node=osmosis_control]')"
    confirm = "$('#signal-confirm')"
    node = fm.NodeInfo("osmosis_control", "control", 77, fm.NodeState.RUNNING, 1, 0)
    async with repeated(lambda: world.others.publish(ftm_topics.NODES, fm.NodeTable((node,)))):
        await tab.until(f"{row} !== null")
        await tab.value(f"{row}.querySelector('button').click()")
        assert await tab.value(f"{confirm}.hidden") is True
        await tab.value("$$('#signals button').find((b) => b.textContent === 'KILL').click()")
        assert await tab.value(f"{confirm}.textContent") == "Send KILL to osmosis_control"
        assert signalled == []
        await tab.value(f"{confirm}.click()")
        await eventually(lambda: signalled == [("osmosis_control", "KILL")])
        await tab.until("$('#toast').textContent === 'osmosis_control (pid 77): KILL'")

    await tab.until("!$('#strategy-set').disabled")
    assert await tab.value("$('#strategy-name').value") == "safety-first"
    await tab.value("$('#strategy-name').value = 'mission-first';$('#strategy-set').click()")
    await eventually(lambda: bool(world.others.adaptations))
    world.others.publish(ftm_topics.ADAPTATION, fm.AdaptationAnswer(
        world.others.adaptations[0].request, True, "", 1))
    await tab.until("$('#toast').textContent"
                    " === 'strategy mission-first is in force, change 1 of the run'")

    submit = "$('#inject').requestSubmit()"
    for chosen, topic in (("gps-bias", "summit_xl/gps"), ("freeze:", "plan/route")):
        await tab.value(
            f"$('#fault').value = '{chosen}';$('#fault').dispatchEvent(new Event('change'));"
            f"$('#fault-topic').value = 'plan/route';$('#fault-duration').value = '4'; {submit}")
        await eventually(lambda topic=topic: any(o.topic == topic for o in world.others.injections))
        order = next(o for o in world.others.injections if o.topic == topic)
        assert order.duration_s == 4.0
        world.others.publish(bus_topics.INJECTION_REPORT, bm.InjectionReport(
            order.injection, "simulator", 12, True, ""))
        await tab.until(f"$('#faults li').textContent.startsWith('{chosen}')")
        await tab.until("$('#faults li').textContent.includes('over, 12 messages changed')")
