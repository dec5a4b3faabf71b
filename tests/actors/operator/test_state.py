"""What the operator's page is told."""

import json
import math

import msgspec

from rampart.actors.bus.envelope import Header
from rampart.actors.ftm import messages as fm
from rampart.actors.operator.state import STALE_S
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis.airport.drawing import draw
from rampart.actors.osmosis.airport.formats import load_airport
from rampart.actors.osmosis.page.state import TRACK_POINTS, OsmosisState
from rampart.manager.strategies.registry import decision_in_words


def shown(state: OsmosisState, now_s: float = 0.0) -> dict:
    state.grow_old(now_s)
    return json.loads(msgspec.json.encode(state.picture.changes(0)))


def test_a_snapshot_of_nothing_heard_is_complete():
    snapshot = shown(OsmosisState(), 1.0)
    assert snapshot["pose"] is snapshot["mission"] is snapshot["nodes"] is None
    assert snapshot["events"] == snapshot["detections"] == snapshot["route"] == []


def test_a_state_not_heard_for_a_while_is_stale():
    state = OsmosisState()
    state.keep("pilot", m.PilotStatus(m.PilotMode.AUTO, False, "", 0), 10.0)
    assert shown(state, 10.0 + STALE_S)["pilot"]["stale"] is False
    assert shown(state, 10.1 + STALE_S)["pilot"]["stale"] is True


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


def test_that_all_nodes_start_at_the_start_is_no_news_but_a_crash_is():
    state = OsmosisState()
    for event in ("started", "running", "crashed", "respawned"):
        state.event(fm.ProcessEvent("hmi", event, 1, 1, "RM4", ""), Header("hmi", 1, 1, 1.0))
    assert [e["text"] for e in shown(state)["events"]] == [
        "hmi crashed, incarnation 1", "hmi respawned by RM4, incarnation 1"]


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


def test_a_decision_is_told_with_its_certificate():
    state = OsmosisState()
    state.decision(fm.DecisionRecord(
        4, "safety-first", ("FTM1", "FTM6"), 2, ("RM1",), ("FTM1 > FTM6",),
        (("RM5", "FTM6 is dominated by FTM1"),), 1.0), 1.1)
    told = shown(state)["decisions"][0]
    assert told["path"] == ["FTM1 > FTM6"]
    assert told["rejected"] == ["RM5: FTM6 is dominated by FTM1"]
    assert "(block 2)" in told["words"]


def test_decisions_are_put_in_words():
    assert decision_in_words(("FTM7",), 1, ("RM4",)) == (
        "RM4: FTM7, because it is the only active mechanism (block 1).")
    assert decision_in_words(("FTM3", "FTM4"), 3, ("RM2",)).startswith(
        "RM2: FTM3 and FTM4")
    assert decision_in_words((), 0, ()) == (
        "No mechanism is active: there is nothing to recover from.")
    assert decision_in_words((), 0, ("RM1",)) == (
        "No mechanism is active any more; RM1 stays in force until reset.")
    assert decision_in_words(("FTM3",), 2, ("RM2", "RM3"), "mission-first") == (
        "RM2 and RM3: FTM3, because a deeper barrier did not end the error in time, "
        "so the next one above takes over (mission-first, rule 2).")
    assert decision_in_words(("FTM3",), 2, ("RM2",), "of-yesterday") == (
        "RM2: FTM3 (of-yesterday, rule 2).")


def test_a_decision_names_titles_first_and_codes_in_brackets():
    titles = {"RM2": "Controlled stop", "FTM14": "No time left"}
    assert decision_in_words(("FTM14", "X"), 1, ("RM2",), titles=titles).startswith(
        "Controlled stop (RM2): No time left (FTM14) and X, ")


def test_a_host_that_is_back_is_good_news_and_a_second_answer_is_none():
    def news(event: str, detail: str = "") -> str:
        return fm.ProcessEvent("ground", event, 1, 1, "supervisor", detail).news

    assert [news("back"), news("respawned"), news("respawned", "already"), news("started"),
            news("unreachable"), news("crashed")] == ["clear", "clear", "", "", "fault", "fault"]


def test_the_drawing_holds_the_whole_airport_within_its_bounds():
    airport = load_airport("vallombre")
    drawing = draw(airport)
    x0, y0, x1, y1 = drawing.bounds_m
    assert len(drawing.lights) == len(airport.lights)
    assert len(drawing.edges) == len(airport.edges)
    assert all(x0 < light.x_m < x1 and y0 < light.y_m < y1 for light in drawing.lights)
    assert drawing.prohibited.count("M") == drawing.prohibited.count("Z") > 1
