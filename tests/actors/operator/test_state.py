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
