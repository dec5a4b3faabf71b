"""What the operator's page shows, in a real Chromium: tree, laser, processes, certificates."""

from __future__ import annotations

import math
import os
from urllib.parse import urlsplit

import pytest
from msgspec.structs import replace

from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.ftm.history import Fault, History
from rampart.actors.operator.hmi import Hmi
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.airport.formats import load_airport
from rampart.actors.osmosis.page.map import MAX_PATHS_BYTES, page_map
from rampart.manager.model.mechanisms import Clears
from rampart.testing import free_port
from tests.actors.operator.browser import mouse
from tests.actors.operator.world import LIVE, SPEC, events, page, repeated, show, text
from tests.actors.osmosis.airport.large import WIDE_M, write_large_airport

pytestmark = pytest.mark.page
LIT = "$$('#tree .line.lit').length"


async def test_detections_light_the_tree_and_lasers_processes_and_decisions_are_shown(world, tab):
    async with page(world, tab):
        await tab.until(f"{text('manager')}.includes('no message yet')")
        assert await tab.value("$$('#tree .event').length") == len(
            SPEC.events)
        assert await tab.value("$$('#tree .barrier').length") == len(
            SPEC.mechanisms)
        async with repeated(lambda: world.others.manager("FTM4", activated=("RM3",))):
            await tab.until(f"{events('active')} === 'FTM4'")
            assert await tab.value(events("ahead")) == "FTM2"
            assert await tab.value(LIT) == 1
            assert "Detected: FTM4" in await tab.value(text("tree-words"))
            running = "$$('#order .running text')[0].textContent"
            assert await tab.value(running) == "RM3"
        async with repeated(world.others.manager):
            await tab.until(f"{events('active')} === ''")
            assert await tab.value(LIT) == 0
        silent = fm.ManagerStatus((), ("DM3",), (), (), "guarded-repair", 1, tuple(
            fm.DetectionView(name, False, "", ()) for name in ("DM2", "DM3")))
        chips = "$$('#detections li').map((c) => c.textContent)"
        async with repeated(lambda: world.others.publish(ftm_topics.MANAGER_STATUS, silent)):
            await tab.until(f"{chips}.join() === 'DM2: idle,? DM3: silent'")

        area = "($('.sweep.lower .sweep-area').getAttribute('d') || '')"
        async with repeated(world.others.busy):
            await tab.until(f"{area}.split('L').length === 92")
            echoes = "$('.sweep.lower .sweep-echoes').getAttribute('d')"
            echo = (await tab.value(echoes)).removeprefix("M").removesuffix("h0").split()
            assert math.dist(map(float, echo), (3.0, 0.0)) < 0.05
            cells = ("$$('#nodes tr[data-node=hmi] td').map((c) => c.textContent)")
            await tab.until(f"$$('#nodes tr').length === "
                            f"{len(SPEC.actors())} && Number({cells}[6]) > 10")
            _, state, pid, _, restarts, cpu, _ = await tab.value(cells)
            assert (state, pid, restarts) == ("running", str(os.getpid()), "0")
            assert float(cpu) > 0
        await tab.until(f"{area} === ''")  # it vanishes when it is not heard

        def decide(number: int) -> None:
            world.others.publish(ftm_topics.DECISION, fm.DecisionRecord(
                number, "safety-first", ("FTM1", "FTM4"), 2, ("RM1",),
                ("FTM1 > FTM2", "FTM2 > FTM4"), (("RM3", "FTM4 is dominated by FTM1"),), 1.0))

        decide(4)
        await tab.until("$$('#decisions details').length === 1")
        await tab.value("$('#decisions summary').click()")
        decide(5)
        await tab.until("$$('#decisions details').length === 2")
        opened = await tab.value("$('#decisions details[open]').textContent")
        for words in ("Certificate of decision 4", "FTM1 > FTM2", "RM3: FTM4 is dominated by FTM1"):
            assert words in opened


async def test_no_reset_is_offered_for_a_mechanism_that_never_clears(world, tab):
    spec = replace(SPEC, mechanisms=tuple(
        replace(x, clears=Clears.NEVER) if x.name == "FTM1" else x for x in SPEC.mechanisms))
    buttons = "$$('#resets button').length"
    async with page(world, tab, system=spec):
        async with repeated(lambda: world.others.manager("FTM1", latched=("RM1",))):
            await tab.until(f"{text('alarm-title')} === 'Emergency stop (RM1): latched.'")
            assert await tab.value(buttons) == 0
        async with repeated(lambda: world.others.manager("FTM2", latched=("RM1",))):
            await tab.until(f"{buttons} === 1 && {text('alarm-title')} === "
                            "'Emergency stop (RM1): latched until you reset it.'")


async def test_values_of_a_lost_connection_are_marked_as_old_and_the_next_shows_nothing_of_them(
        world, tab):
    port = free_port()
    old = "document.body.classList.contains('offline')"
    async with world.hmi(hmi_port=port, system=SPEC) as hmi:
        await show(tab, hmi)
        async with repeated(world.others.busy):
            await tab.until(f"{events('active')} === 'FTM4'")
            await tab.until("$$('#events .fault').length === 1")
            assert await tab.value(old) is False
            hmi._server._feed._pages.clear()  # as a cable that is pulled: nothing arrives
            await tab.until(old, 2.5)  # within two seconds, and half a one for this test itself
            assert "all values" in (await tab.value(text("cut"))).lower()
    world.others.manager()
    async with world.hmi(incarnation=2, hmi_port=port, system=SPEC):
        async with repeated(world.others.manager):
            await tab.until(f"{LIVE} && {events('active')} === '' && $('#alarm').hidden")
            assert await tab.value("$$('#events .fault').length") == 0
            assert await tab.value("$$('#tree .event').length") == len(
                SPEC.events)


async def test_the_faults_of_all_runs_are_listed_and_a_machine_that_is_late_is_a_banner(
        world, tab, tmp_path):
    panel, rows = "$('#history-panel')", "#history tr"
    history = History(tmp_path, "r0")
    late = fm.NodeTable((fm.NodeInfo("hmi", "non-control", 1, fm.NodeState.RUNNING, 1, 0,
                                   late_s=5.0),))
    async with world.hmi(system=SPEC, black_box=str(tmp_path)) as hmi:
        await show(tab, hmi)
        assert await tab.value(f"{panel}.hidden") is True
        history.put([Fault(mechanism="DM7", node="localization", error="<b>gone</b>",
                           state="confirmed", times=3)], 1.8e9)
        await tab.until(f"!{panel}.hidden && $$('{rows}').length === 1")
        cells = f"$$('{rows} > *').map((cell) => cell.textContent)"
        shown = await tab.value(cells)
        assert shown[:4] + shown[5:] == ["DM7", "localization", "confirmed", "3", "<b>gone</b>"]
        async with repeated(lambda: world.others.publish(ftm_topics.NODES, late)):
            await tab.until("!$('#behind').hidden", 30)
        words = await tab.value(text("behind"))
        assert words.startswith("this machine keeps up with rate ")
    history.close()


# -- The map of an airport of 8 km in Chromium: marks keep their size, zoom and pan work --


BOX = "$('#map').viewBox.baseVal"


def size_px(selector: str) -> str:
    """Return an expression for the width on the screen of what a selector finds first."""
    return f"$({selector!r}).getBoundingClientRect().width"


@pytest.fixture(scope="module")
def large(tmp_path_factory):
    return load_airport(write_large_airport(tmp_path_factory.mktemp("airport") / "large.toml"))


async def test_an_airport_of_8_km_is_drawn_zoomed_and_moved_and_its_marks_keep_their_size(
        world, tab, large):
    mission = m.MissionStatus("r1/first", "A", m.MissionPhase.RUNNING, 1, tuple(
        m.Goal(g.x_m, g.y_m, m.Mode(g.mode)) for g in large.mission("A").goals),
        (12.0,), (), "")

    def drive() -> None:
        world.others.publish(topics.POSE, m.Pose(500.0, -520.0, 0.5))
        world.others.publish(topics.MISSION_STATUS, mission)

    async with page(world, tab, airport=large), repeated(drive):
        await tab.until("$$('#map .goal').length > 3")
        await tab.until("$('.robot').getAttribute('visibility') === 'visible'")
        assert await tab.value(f"{BOX}.width > {WIDE_M}") is True
        assert await tab.value("$$('#map .pavement').length") > 1000
        ring, goal = size_px("#map .robot-ring"), size_px("#map .goal")
        sizes = [await tab.value(ring), await tab.value(goal)]
        assert 12 < min(sizes) <= max(sizes) < 80, sizes
        await tab.value("$('#follow').click()")
        await tab.until(f"{BOX}.width < 30")
        assert await tab.value(ring) == pytest.approx(sizes[0], rel=0.05)
        await tab.value("$('[title=\"Show the whole map\"]').click()")
        await tab.until(f"{BOX}.width > {WIDE_M}")

        at = await tab.value("(() => { const r = $('#map')"
                             ".getBoundingClientRect(); return [r.x + r.width / 4,"
                             " r.y + r.height / 4]; })()")
        place = (f"(() => {{ const p = new DOMPoint({at[0]}, {at[1]}).matrixTransform("
                 "$('#map').getScreenCTM().inverse()); return [p.x, p.y]; })()")
        before = await tab.value(place)
        await tab.call("Input.dispatchMouseEvent", type="mouseWheel", x=at[0], y=at[1],
                       deltaX=0, deltaY=-1500)
        await tab.until(f"{BOX}.width < {WIDE_M / 4}")
        assert await tab.value(place) == pytest.approx(before, abs=20)  # what was under it stays
        left = await tab.value(f"{BOX}.x")
        width = await tab.value(f"{BOX}.width")
        await mouse(tab, "mousePressed", *at)
        await mouse(tab, "mouseMoved", at[0] + 50, at[1])
        await mouse(tab, "mouseReleased", at[0] + 50, at[1])
        await tab.until(f"{BOX}.x < {left} - 10")
        assert await tab.value(f"{BOX}.width") == pytest.approx(width)
        for key, sign in (("+", "<"), ("-", ">")):
            now = await tab.value(f"{BOX}.width")
            await tab.value("$('#map').dispatchEvent("
                            f"new KeyboardEvent('keydown', {{ key: '{key}' }}))")
            await tab.until(f"{BOX}.width {sign} {now}")
        await tab.value("$('#map').dispatchEvent(new KeyboardEvent('keydown', { key: '0' }))")
        await tab.until(f"{BOX}.width > {WIDE_M}")


def test_more_outlines_than_there_is_room_for_are_drawn_coarser_and_not_refused(large):
    found = page_map(large)
    assert found.left_out.keys() <= {"lights"}
    assert len(bytes(found.encoded)) < 3 * MAX_PATHS_BYTES


# -- The operator's page for everybody: on a phone, in the dark, by keyboard, by ear, offline --


WIDE = """$$('main *').filter((e) =>
    e.getBoundingClientRect().right > 361 && !e.closest('.across, .scroll'))
    .map((e) => e.tagName + '#' + e.id + '.' + e.className).join()"""
NAMED = {"application", "button", "checkbox", "columnheader", "combobox", "group", "image", "link",
         "log", "progressbar", "region", "rowheader", "slider", "spinbutton", "table", "textbox"}
"""Roles of what needs a name to be of use to who does not see it."""

WRONG = """(() => {
  const wrong = [];
  const ids = $$('[id]').map((e) => e.id);
  ids.filter((id, i) => ids.indexOf(id) !== i).forEach((id) => wrong.push(`twice: ${id}`));
  for (const name of ['aria-labelledby', 'aria-describedby', 'for']) {
    for (const id of $$(`[${name}]`).flatMap((e) => e.getAttribute(name).split(' '))) {
      if (!ids.includes(id)) wrong.push(`${name} names nobody: ${id}`);
    }
  }
  for (const e of $$('main *')) {
    const style = getComputedStyle(e);
    if (e.checkVisibility() && /(auto|scroll)/.test(style.overflowX + style.overflowY)
        && (e.scrollHeight > e.clientHeight + 1 || e.scrollWidth > e.clientWidth + 1)
        && e.tabIndex < 0) wrong.push(`scrolls without the keyboard: ${e.id || e.className}`);
  }
  return wrong.join('\\n');
})()"""

PALE = """(() => {
  const pale = new Set();
  const canvas = document.createElement('canvas').getContext('2d', { willReadFrequently: true });
  const rgb = (colour) => {
    canvas.clearRect(0, 0, 1, 1);
    canvas.fillStyle = colour;
    canvas.fillRect(0, 0, 1, 1);
    return [...canvas.getImageData(0, 0, 1, 1).data];
  };
  const light = ([r, g, b]) => [r, g, b].map((c) => c / 255).map(
    (c) => (c <= .03928 ? c / 12.92 : ((c + .055) / 1.055) ** 2.4))
    .reduce((sum, c, i) => sum + c * [.2126, .7152, .0722][i], 0);
  const behind = (e) => {
    for (; e; e = e.parentElement) {
      const back = rgb(getComputedStyle(e).backgroundColor);
      if (back[3] > 250) return back;
    }
    return [255, 255, 255];
  };
  for (const e of $$('body *:not(svg *)')) {
    const text = [...e.childNodes].some((n) => n.nodeType === 3 && n.textContent.trim());
    if (!text || !e.checkVisibility() || e.closest('.unseen, .skip, :disabled, option')) continue;
    const [a, b] = [light(rgb(getComputedStyle(e).color)), light(behind(e))];
    const ratio = (Math.max(a, b) + .05) / (Math.min(a, b) + .05);
    if (ratio < 4.5) pale.add(`${ratio.toFixed(2)} ${e.className} ${e.textContent.slice(0, 30)}`);
  }
  return [...pale].join('\\n');
})()"""


@pytest.mark.parametrize("scheme", ["light", "dark"])
async def test_everything_has_a_name_can_be_read_and_reached_and_fits_a_phone(world, tab, scheme):
    busy = f"{events('active')} === 'FTM4' && $$('#nodes tr').length > 0"
    async with page(world, tab, scheme=scheme) as hmi, repeated(world.others.busy):
        await tab.until(busy)
        tree = await tab.call("Accessibility.getFullAXTree")  # as a screen reader gets it
        assert [node for node in tree["nodes"] if not node["ignored"]
                and node["role"]["value"] in NAMED and not node["name"]["value"].strip()] == []
        assert await tab.value(WRONG) == ""
        assert await tab.value(PALE) == ""
        await show(tab, hmi, scheme=scheme, width=360, height=740)
        await tab.until(busy)
        assert await tab.value("document.documentElement.scrollWidth") == 360
        assert await tab.value(WIDE) == ""
        assert {urlsplit(url).hostname for url in tab.requests
                if not url.startswith("data:")} == {"127.0.0.1"}, "it asks nobody but the HMI"


async def test_the_first_stop_of_the_keyboard_skips_to_the_map_and_nothing_has_to_move(world, tab):
    async with page(world, tab, motion="reduce"):
        assert await tab.value("parseFloat(getComputedStyle($("
                               "'.event .box')).transitionDuration)") == 0
        for kind in ("rawKeyDown", "keyUp"):
            await tab.call("Input.dispatchKeyEvent", type=kind, key="Tab", code="Tab",
                           windowsVirtualKeyCode=9)
        assert await tab.value("document.activeElement.className") == "skip"
        await tab.value("window.still = true; document.activeElement.click()")
        await tab.until(f"location.hash === '#main' && {LIVE}")
        assert await tab.value("window.still") is True  # and the connection was kept


async def test_a_robot_that_offers_nothing_has_a_page_without_map_stick_and_mission(world, tab):
    plain = Hmi(world.context("hmi", 1, system=SPEC))
    async with world.running(plain), repeated(world.others.busy):
        await show(tab, plain)
        await tab.until(f"{events('active')} === 'FTM4'")
        await tab.until("$$('#nodes tr').length > 0")
        shown = await tab.value("$$('.panel h2')"
                                ".filter((e) => e.checkVisibility()).map((e) => e.id).join()")
        assert shown.split(",") == ["safety-title", "tree-title", "decisions-title", "events-title",
                                    "order-title", "nodes-title", "fault-heading"]
