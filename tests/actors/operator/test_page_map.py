"""The map of an airport of 8 km in Chromium: marks keep their size, zoom and pan work."""

from __future__ import annotations

import pytest

from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.airport.formats import load_airport
from rampart.actors.osmosis.page.map import MAX_PATHS_BYTES, page_map
from tests.actors.operator.browser import mouse
from tests.actors.operator.page import page
from tests.actors.operator.world import repeated
from tests.actors.osmosis.airport.large import WIDE_M, write_large_airport

pytestmark = pytest.mark.page
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
