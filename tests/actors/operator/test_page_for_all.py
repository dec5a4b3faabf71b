"""The operator's page for everybody: on a phone, in the dark, by keyboard, by ear, offline."""

from __future__ import annotations

from urllib.parse import urlsplit

import pytest

from rampart.actors.operator.hmi import Hmi
from tests.actors.operator.page import LIVE, events, page, show
from tests.actors.operator.world import SPEC, repeated

pytestmark = pytest.mark.page


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
