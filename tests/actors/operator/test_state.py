"""What the operator's page is told."""

import json
import math

import msgspec

from rampart.actors.ftm import messages as fm
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis.page.state import TRACK_POINTS, OsmosisState


def shown(state: OsmosisState, now_s: float = 0.0) -> dict:
    state.grow_old(now_s)
    return json.loads(msgspec.json.encode(state.picture.changes(0)))


def test_the_track_has_a_point_where_the_robot_has_moved_and_a_limit():
    state = OsmosisState()
    for i in range(3 * TRACK_POINTS):
        state.pose(m.Pose(i * 0.1, 0.0, 0.0), 0.05 * i, 0.05 * i)
    assert len(state.track) == TRACK_POINTS
    gaps = [b[0] - a[0] for a, b in zip(state.track, list(state.track)[1:], strict=False)]
    assert min(gaps) > 0.24


def test_a_corrupt_pose_neither_breaks_the_track_nor_the_json():
    state = OsmosisState()
    state.pose(m.Pose(math.nan, math.inf, 0.0), 1.0, 1.0)
    assert not state.track
    assert shown(state, 1.0)["pose"]["value"]["x_m"] is None


def test_a_detection_is_logged_when_it_begins_and_when_it_ends():
    state = OsmosisState()
    active, idle = True, False
    for at_s, which in enumerate([idle, idle, active, active, idle, idle]):
        view = fm.DetectionView("DM2", which, "stale" if which else "", ())
        state.manager(fm.ManagerStatus((), (), (), (), "safety-first", 0, (view,)), float(at_s))
    assert [(e["t"], e["kind"], e["text"]) for e in shown(state)["events"]] == [
        (2.0, "fault", "DM2: stale"), (4.0, "clear", "DM2: clear")]


def test_lights_come_from_the_status_and_from_passing_and_a_new_mission_forgets_them():
    state = OsmosisState()
    light = m.LightMeasurement("A01", 100.0, 0.5, m.LightVerdict.OK)
    state.mission(m.MissionStatus("1", "A", m.MissionPhase.RUNNING, 0, (), (), (light,), ""), 1.0)
    state.light(m.LightMeasurement("A02", 0.0, 0.0, m.LightVerdict.OUT))
    assert {k: v["verdict"] for k, v in shown(state)["lights"].items()} == {
        "A01": "ok", "A02": "out"}
    state.mission(m.MissionStatus("", "", m.MissionPhase.IDLE, 0, (), (), (), ""), 2.0)
    assert set(shown(state)["lights"]) == {"A01", "A02"}
    state.mission(m.MissionStatus("2", "A", m.MissionPhase.RUNNING, 0, (), (), (), ""), 3.0)
    assert shown(state)["lights"] == {}
