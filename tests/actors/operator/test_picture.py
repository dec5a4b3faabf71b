"""The picture that pages are shown: what changed since a version, and the push that sends it."""

from __future__ import annotations

import asyncio
import json
from contextlib import asynccontextmanager

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rampart.actors.operator import feed as hmi_feed
from rampart.actors.operator.feed import Feed
from rampart.actors.operator.picture import JOURNAL_LINES, Picture
from rampart.actors.operator.state import STALE_S
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis.page.state import POINTS, OsmosisState, thin
from rampart.testing import eventually


def as_json(value: object) -> dict:
    return json.loads(msgspec.json.encode(value))


class FakePage:
    """Keeps a picture from frames, as the page's script does."""

    def __init__(self) -> None:
        self.known: dict = {}

    def take(self, text: str) -> dict:
        frame = json.loads(text)
        for log in ("decisions", "events"):
            if log in frame:
                frame[log] = [*self.known.get(log, ()), *frame[log]][-JOURNAL_LINES:]
        self.known |= frame
        return self.known


@given(st.lists(st.one_of(
    st.tuples(st.just("put"), st.sampled_from(("pose", "pilot")), st.integers(0, 3)),
    st.tuples(st.just("log"), st.just("events"), st.integers(0, 3)),
    st.tuples(st.just("frame"), st.just(""), st.just(0)))))
def test_whatever_frames_a_page_missed_it_ends_up_with_the_whole_picture(steps):
    picture, page, version = Picture(), FakePage(), 0
    for name in ("pose", "pilot"):
        picture.section(name)
    picture.journal("events")
    for what, name, value in (*steps, ("frame", "", 0)):
        if what == "put":
            picture.put(name, value)
        elif what == "log":
            picture.add(name, value)
        else:
            page.take(msgspec.json.encode(picture.changes(version)).decode())
            version = picture.version
            assert picture.changes(version) == {"left_out": {}}
    assert {"events": [], **page.known} == as_json(picture.changes(0))


def test_silence_is_shown_once_and_the_next_message_ends_it():
    state = OsmosisState()
    state.pose(m.Pose(1.0, 2.0, 0.0), 5.0, 5.0)
    state.grow_old(5.0 + STALE_S + 0.1)
    version = state.picture.version
    assert as_json(state.picture.changes(0))["pose"]["stale"] is True
    state.grow_old(8.0)
    assert state.picture.version == version
    state.pose(m.Pose(1.0, 2.0, 0.0), 9.0, 9.0)
    assert as_json(state.picture.changes(0))["pose"]["stale"] is False


# ---- the laser -----------------------------------------------------------------------------------


def scan(ranges: list[float], **changed: float) -> m.LaserScan:
    values = {"angle_min_rad": -1.0, "angle_increment_rad": 0.01, "range_max_m": 8.0} | changed
    return m.LaserScan(**values, ranges_f32=np.array(ranges, dtype="<f4").tobytes())


def test_an_obstacle_that_a_single_ray_has_hit_stays_in_the_thinned_sweep():
    for hit in range(181):
        ranges = [8.0] * 181
        ranges[hit] = 2.5
        thinned = thin(scan(ranges))
        assert len(thinned["cm"]) <= POINTS
        assert thinned["cm"].count(250) == 1
        angle = thinned["from_rad"] + thinned["cm"].index(250) * thinned["step_rad"]
        assert abs(angle - (-1.0 + 0.01 * hit)) < 0.0101


# ---- the push ------------------------------------------------------------------------------------


@asynccontextmanager
async def pushing():
    """Yield state, page, frames and task of a feed with one page, which has received all."""
    state, frames = OsmosisState(), []
    state.log(0.0, "note", "before")
    feed = Feed(state, lambda: 1.0, lambda: {"type": "hello"})

    async def send(text: str) -> None:
        frames.append(json.loads(text))

    with feed.page() as page:
        task = asyncio.create_task(feed.push(page, send))
        await eventually(lambda: len(frames) >= 2)
        try:
            yield state, page, frames, task
        finally:
            task.cancel()
            await asyncio.wait([task])


async def test_a_page_is_greeted_then_gets_everything_then_changes():
    async with pushing() as (state, _, frames, _):
        hello, whole = frames[:2]
        assert hello == {"type": "hello"}
        assert [e["text"] for e in whole["events"]] == ["before"]
        assert set(state.picture.changes(0)) <= set(whole)
        state.keep("pilot", m.PilotStatus(m.PilotMode.STOP, True, "", 0), 1.0)
        await eventually(lambda: bool(frames[-1].get("pilot")))
        assert set(frames[-1]) == {"type", "version", "time_s", "pilot", "left_out"}


async def test_a_page_that_answers_has_one_frame_on_the_way_and_then_the_newest():
    async with pushing() as (state, page, frames, _):
        for i in range(30):
            page.seen(0)  # an older frame than the last
            state.keep("pilot", m.PilotStatus(m.PilotMode.STOP, True, str(i), 0), 1.0)
            await asyncio.sleep(hmi_feed.FRAME_GAP_S / 4)
        on_the_way = len(frames)
        assert on_the_way <= 3  # the greeting, everything, and the first change
        page.seen(frames[-1]["version"])
        await eventually(lambda: frames[-1]["pilot"]["value"]["reason"] == "29")
        assert len(frames) == on_the_way + 1


async def test_a_page_that_draws_nothing_is_given_up(monkeypatch):
    monkeypatch.setattr(hmi_feed, "SEND_TIMEOUT_S", 0.3)
    async with pushing() as (state, page, _, task):
        page.seen(0)
        state.log(1.0, "note", "news")
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(asyncio.shield(task), 5)
