"""Panels in a real Chromium: what they show, where they are, folded, moved, and hostile."""

from __future__ import annotations

import json
from contextlib import asynccontextmanager

import pytest

from rampart.actors.operator.panels import Panel
from rampart.testing import eventually
from tests.actors.operator.browser import mouse
from tests.actors.operator.test_page_operating import key
from tests.actors.operator.test_panels import AT_REST, DRIVE, PANELS, Speaks, driven, hmi, rests
from tests.actors.operator.world import LIVE, page, repeated, show
from tests.tank import LEVEL, PUMP, VALVE, Hand, Level, Phase, Pump, Valve

pytestmark = pytest.mark.page

SHOWN = (*PANELS[:2], Panel(title="Pump", states="tank/pump:phase", of=("idle", "filling")),
         *PANELS[3:], Panel(title="Where", map=("tank/level:height_m", "tank/level:heading_rad",
                                                "tank/level:heading_rad")))
BODY = "$('[data-name=\"{}\"] .inside')"
DRAWN = """(() => {  // width of what a plot shows, pixels
  const canvas = $('.plot canvas');
  if (!canvas) return 0;
  const { width, height } = canvas;
  const copy = new OffscreenCanvas(width, height).getContext('2d', { willReadFrequently: true });
  copy.drawImage(canvas, 0, 0);
  const seen = copy.getImageData(0, 0, width, height).data;
  const blue = (x) => [...Array(height).keys()].some((y) => {
    const [r, g, b, a] = seen.subarray(4 * (y * width + x));
    return a > 128 && b > r + 80 && b > g + 40;
  });
  return [...Array(width).keys()].filter(blue).length;
})()"""
NAMES = ("$$('main > .panel').filter((p) => !p.hidden).map((p) => p.dataset.name)")
OVERLAPS = """(() => {
  const boxes = $$('main > .panel').filter((p) => !p.hidden)
    .map((p) => p.getBoundingClientRect());
  const found = [];
  for (let i = 0; i < boxes.length; i += 1) for (let j = 0; j < i; j += 1) {
    const [a, b] = [boxes[i], boxes[j]];
    if (a.left < b.right - 1 && b.left < a.right - 1 && a.top < b.bottom - 1
        && b.top < a.bottom - 1) found.push(`${i} lies on ${j}`);
  }
  for (const p of $$('main > .panel:not([hidden])')) {
    if (p.scrollWidth > p.clientWidth) found.push(`${p.dataset.name} overflows`);
  }
  if (document.documentElement.scrollWidth > innerWidth) found.push('the window is too narrow');
  return found.join();
})()"""


@asynccontextmanager
async def tank(world, tab, panels=SHOWN, **look):
    """Show a page with panels of a tank; yields one who says what they show."""
    said = Speaks(world.context("speaks", 1))
    async with world.running(said), world.running(hmi(world, panels)) as made:
        await show(tab, made, **look)
        yield said


def text(name: str) -> str:
    return f"{BODY.format(name)}.textContent"


async def test_each_panel_shows_its_fields_their_past_and_whether_they_are_heard(world, tab):
    async with tank(world, tab) as said:
        assert "no data" in await tab.value(text("Level"))
        height = 0.25

        def say() -> None:
            said.publish(LEVEL, Level(height, (1.0, 3.5), 0.5))
            said.publish(PUMP, Pump(Phase.FILLING))
            said.publish(VALVE, Valve(True))

        async with repeated(say):
            await tab.until(f"{text('Level')}.startsWith('0.25')")
            meter = f"{BODY.format('Level')}.querySelector('[role=meter]')"
            await tab.until(f"{meter}.getAttribute('aria-valuenow') === '0.25'")
            now = f"{BODY.format('Pump')}.querySelector('[aria-current]')?.textContent"
            await tab.until(f"{now} === 'filling'")
            await tab.until(f"{text('All')}.includes('3.5') && {text('All')}.includes('true')")
            await tab.until(f"{text('Where')}.includes('x 0.25 m, y 0.50 m, heading 29°')")
            width = f"{BODY.format('Where')}.querySelector('svg').viewBox.baseVal.width"
            whole = await tab.value(width)
            zoom = "$('[data-name=Where] [title=\"Zoom in\"]')"
            await tab.value(f"{zoom}.click()")
            await tab.until(f"{width} < {whole}")
            height = 0.75
            await tab.until(f"{DRAWN} > 20")
            await tab.until(f"{text('Over time')}.includes('0.75')")
        await tab.until(f"{text('Level')}.includes('(stale)')")
        said.publish(PUMP, Pump(Phase.DRAINING))  # which is not among the states of the panel
        await tab.until(f"{now} === 'draining'")
        await tab.call("Page.reload")
        await tab.until(f"{LIVE} && {DRAWN} > 10")  # a page that opens later shows the past
        await tab.value(f"Object.defineProperty({BODY.format('Level')}.querySelector('.figure'),"
                        " 'textContent', { get() { throw Error('broken on purpose'); } })")
        async with repeated(lambda: said.publish(LEVEL, Level(0.5, (4.5,)))):
            await tab.until(f"{text('All')}.includes('4.5')")  # it takes nothing else along
        assert tab.errors != []  # it is said
        tab.errors.clear()


@pytest.mark.parametrize("of_the_robot", [False, True])
async def test_no_panel_lies_on_another_or_is_too_narrow(world, tab, of_the_robot):
    shown = page(world, tab) if of_the_robot else tank(world, tab)
    async with shown, repeated(world.others.busy):
        for width, height in ((1920, 1080), (1366, 768), *([] if of_the_robot else [(1100, 700)])):
            await tab.show(await tab.value("location.href"), width=width, height=height)
            await tab.until(f"{LIVE} && $$('#nodes tr').length > 0")
            await tab.until(f"{OVERLAPS} === ''", 5)
            if of_the_robot:
                end = "$('#tree').getBoundingClientRect().bottom"
                assert await tab.value(end) < height or height < 1080  # above the fold
                continue
            await tab.value("$('.panel summary').click()")
            await tab.until(f"{OVERLAPS} === ''", 5)
            await tab.value("$('#arrange-reset').click()")


async def test_a_panel_is_moved_by_keyboard_and_mouse_and_folded_and_the_page_remembers(world, tab):
    async with tank(world, tab, width=1920, height=1080):
        before = await tab.value(NAMES)
        assert before[:3] == ["Level", "Over time", "Pump"]
        await tab.value("$('[data-name=\"Pump\"] .tool').focus()")
        for name, place in (("ArrowUp", 2), ("ArrowLeft", 1)):
            for kind in ("rawKeyDown", "keyUp"):
                await tab.call("Input.dispatchKeyEvent", type=kind, key=name, code=name)
            assert await tab.value("$('#arrange-said').textContent") == (
                f"Pump: place {place} of {len(before)}")
        assert (await tab.value(NAMES))[:3] == ["Pump", "Level", "Over time"]
        focus = "document.activeElement.closest('.panel').dataset.name"
        assert await tab.value(focus) == "Pump"
        await tab.value("$('[data-name=\"Level\"] summary').click()")
        await tab.until("JSON.stringify(localStorage).includes('folded\\\\\":[\\\\\"Level')")
        await tab.call("Page.reload")
        await tab.until(f"{LIVE} && {NAMES}[0] === 'Pump'")
        folded = "$('[data-name=\"Level\"]').open"
        assert await tab.value(folded) is False
        key = await tab.value("Object.keys(localStorage)[0]")
        for kept in ("{", '{"order": 3, "folded": {}}',  # nonsense in its memory does no harm
                     '{"order": ["__proto__", null, "Pump", "Pump"], "folded": ["<b>", "Pump"]}'):
            await tab.value(f"localStorage.setItem({json.dumps(key)}, {json.dumps(kept)});"
                            "window.before = true")
            await tab.call("Page.reload")
            await tab.until(f"window.before === undefined && {LIVE}"
                            f" && {NAMES}.length === {len(before)}")
            assert sorted(await tab.value(NAMES)) == sorted(before)
        await tab.value("$('#arrange-reset').click()")
        assert await tab.value(NAMES) == before
        assert await tab.value(folded) is True
        await tab.until(f"{OVERLAPS} === ''", 5)
        at = ("JSON.stringify((() => {{ const b = $('[data-name=\"{}\"] {}')"
              ".getBoundingClientRect(); return [b.left + b.width / 2, b.top + 8]; }})())")
        fro = json.loads(await tab.value(at.format("Level", ".tool")))
        to = json.loads(await tab.value(at.format("Pump", "h2")))
        for kind, at in (("mousePressed", fro), ("mouseMoved", to), ("mouseReleased", to)):
            await mouse(tab, kind, *at)
        await tab.until(f"{NAMES}[2] === 'Level'")


async def test_what_grows_by_itself_moves_nothing_under_a_hand_that_is_about_to_press(world, tab):
    async with tank(world, tab, width=1100, height=700):
        await tab.until(f"{OVERLAPS} === ''", 5)
        below = await tab.value(
            "(() => { const top = (p) => p.getBoundingClientRect();"
            " const level = top($('[data-name=Level]'));"
            " return $$('main > .panel').find((p) => !p.hidden"
            " && top(p).left === level.left && top(p).top > level.top).dataset.name; })()")
        fold = f"$('[data-name=\"{below}\"] summary')"
        where = (f"JSON.stringify((() => {{ const b = {fold}.getBoundingClientRect();"
                 " return [b.left + b.width / 2, b.top + b.height / 2]; })())")
        frames = ("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame("
                  "() => requestAnimationFrame(() => done(true)))))")
        before = await tab.value(where)
        x, y = json.loads(before)
        await mouse(tab, "mouseMoved", x, y)
        await mouse(tab, "mousePressed", x, y)
        await tab.value(f"{BODY.format('Level')}.append(Object.assign("
                        "document.createElement('div'), {style: 'height: 300px'}))")
        await tab.call("Runtime.evaluate", expression=frames, awaitPromise=True)
        assert await tab.value(where) == before
        await mouse(tab, "mouseReleased", x, y)
        assert await tab.value(f"{fold}.closest('.panel').open") is False
        await tab.until(f"{where} !== {json.dumps(before)} && {OVERLAPS} === ''", 5)


# -- Several declared sticks in a real Chromium --


LIFT = Panel(title="Lift", stick=("tank/level:height_m",), scale=(3.0,))


def of(panel: str, part: str) -> str:
    return f"$('[data-name=\"{panel}\"] {part}')"


def state(panel: str = "Drive") -> str:
    return f"{of(panel, '.stick-state')}.textContent"


@pytest.mark.usefixtures("patient")
async def test_of_two_sticks_each_has_its_keys_and_the_gamepad_is_the_first_one_s(world, tab):
    async with driven(world, DRIVE, LIFT) as (robot, hmi, _):
        await show(tab, hmi)
        await tab.until(f"{state()} === 'free'")
        await tab.value(f"{of('Lift', '.stick')}.focus()")
        await key(tab, "a", down=True)
        await rests(robot)
        assert await tab.value(state("Lift")) == "free"  # it has no such direction
        await key(tab, "w", down=True)
        await tab.until(f"{state('Lift')} === 'you drive'")
        assert robot.hands == [AT_REST]
        await key(tab, "w", down=False)
        await tab.value(
            "navigator.getGamepads = () => [{connected: true, axes: [0, -1], buttons:"
            " Array.from({length: 8}, (_, i) => ({pressed: window.held && i === 4}))}];"
            "dispatchEvent(new Event('gamepadconnected')); window.held = true")
        await eventually(lambda: robot.hands[-1] == Hand(0.25, 0.0, True))
        assert await tab.value(state("Lift")) == "free"
        await tab.value("window.held = false")
        await rests(robot)
