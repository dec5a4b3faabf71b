"""What pages are shown: changes since a version, their push, drawings, processes."""

from __future__ import annotations

import asyncio
import json
from contextlib import asynccontextmanager
from itertools import combinations

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rampart.actors.ftm import messages as fm
from rampart.actors.machine.process_usage import ProcessCount, UsageMeter
from rampart.actors.operator import feed as hmi_feed
from rampart.actors.operator.feed import Feed
from rampart.actors.operator.picture import JOURNAL_LINES, Picture
from rampart.actors.operator.processes import ProcessObserver
from rampart.actors.operator.state import STALE_S
from rampart.actors.operator.system import BARRIER, MAX_BOXES, draw_system
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis.page.state import POINTS, OsmosisState, thin
from rampart.actors.supervision.process_title import RunProcess
from rampart.manager.spec.schema import EventSpec
from rampart.manager.spec.specification import parse_specification
from rampart.testing import eventually
from tests import system_file


def as_json(value: object) -> dict:
    return json.loads(msgspec.json.encode(value))


@given(st.lists(st.one_of(
    st.tuples(st.just("put"), st.sampled_from(("pose", "pilot")), st.integers(0, 3)),
    st.tuples(st.just("log"), st.just("events"), st.integers(0, 3)),
    st.tuples(st.just("frame"), st.just(""), st.just(0)))))
def test_whatever_frames_a_page_missed_it_ends_up_with_the_whole_picture(steps):
    picture, known, version = Picture(), {}, 0  # as the page's script keeps it
    for name in ("pose", "pilot"):
        picture.section(name)
    picture.journal("events")
    for what, name, value in (*steps, ("frame", "", 0)):
        if what == "put":
            picture.put(name, value)
        elif what == "log":
            picture.add(name, value)
        else:
            frame, version = as_json(picture.changes(version)), picture.version
            if "events" in frame:
                frame["events"] = [*known.get("events", ()), *frame["events"]][-JOURNAL_LINES:]
            known |= frame
            assert picture.changes(version) == {"left_out": {}}
    assert {"events": [], **known} == as_json(picture.changes(0))


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


# -- The drawing of a system for the page, and what its processes use --


def system(name: str):
    return parse_specification(system_file(name).read_text(encoding="utf-8"), name)


@pytest.mark.parametrize("name", ["osmosis", "paper", "cell"])
def test_boxes_lie_apart_within_the_drawing_and_lines_join_them_to_the_right(name):
    drawn = draw_system(system(name))
    for drawing in (drawn["tree"], drawn["order"]):
        for one, other in combinations(drawing.boxes, 2):
            assert (one.x + one.width < other.x or other.x + other.width < one.x
                    or one.y + one.height < other.y or other.y + other.height < one.y)
        for box in drawing.boxes:
            assert 0 <= box.x <= drawing.width - box.width
            assert 0 <= box.y <= drawing.height - box.height
    at = {box.name: box for box in drawn["tree"].boxes}
    for line in drawn["tree"].lines:
        upper, lower = at[line.upper], at[line.lower]
        assert upper.x + upper.width < line.points[0][0] < line.points[-1][0] <= lower.x - BARRIER
        assert lower.y <= line.points[-1][1] <= lower.y + lower.height


def test_a_tree_that_nobody_could_read_is_not_drawn_and_the_page_says_so():
    spec = system("paper")
    leaf = next(event for event in spec.events if not event.of)
    more = tuple(EventSpec(f"more_{i}") for i in range(MAX_BOXES))
    events = tuple(
        msgspec.structs.replace(e, gate="or", of=tuple(x.name for x in more)) if e is leaf else e
        for e in spec.events)
    drawn = draw_system(msgspec.structs.replace(spec, events=(*events, *more)))
    assert drawn["tree"] is None
    assert drawn["order"] is not None
    assert drawn["note"] == (
        f"The fault tree has {len(events) + MAX_BOXES} events, too many to draw "
        f"(at most {MAX_BOXES}).")


# ---- processes -----------------------------------------------------------------------------------


def test_nodes_and_guards_that_exist_are_measured_and_processes_of_another_run_are_not():
    alive, now_s = {10, 11, 20, 30}, 100.0

    def count(pid: int) -> ProcessCount | None:
        return ProcessCount((now_s - 90) / 2, 50_000_000, 90.0) if pid in alive else None

    def table(**pids: int) -> fm.NodeTable:
        return fm.NodeTable(tuple(fm.NodeInfo(name, "control", pid, fm.NodeState.RUNNING, 1, 0)
                                 for name, pid in pids.items()))

    observer = ProcessObserver(
        7450, 5, meter=UsageMeter(count, lambda: now_s), find=lambda _port: [
            RunProcess(10, 7450, 5, ("hmi",), 1), RunProcess(20, 7450, 5, ("pool",), 3),
            RunProcess(30, 7450, 99, ("pool",), 1)],
        state=lambda pid: "S" if pid in alive else "X")
    looked = observer.look(None)  # without a table no process is taken for a guard
    assert ([g["name"] for g in looked["guards"]], looked["nodes"]) == (["launch.py"], {})
    looked = observer.look(table(hmi=10, localization=11))
    assert looked["nodes"] == {name: {"cpu": 50.0, "mb": 50.0, "age_s": 10}
                               for name in ("hmi", "localization", "pool")}
    assert [(g["name"], g["pid"], g["state"], g["restarts"]) for g in looked["guards"]] == [
        ("launch.py", 5, "crashed", 0), ("pool", 20, "running", 2)]
    alive, now_s = {20}, 101.0
    assert set(observer.look(table(hmi=10, never=0))["nodes"]) == {"pool"}
