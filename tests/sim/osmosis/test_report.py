"""What a run is judged and reported to be, by timelines of ground truth and of messages."""

from __future__ import annotations

import math
import re

import msgspec
import pytest

from rampart.actors.bus import messages as bm
from rampart.actors.bus import topics as bus_topics
from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.airport.formats import load_airport
from rampart.actors.osmosis.airport.model import MissionGoal
from rampart.actors.osmosis.messages import GroundTruth, Pose, Twist
from rampart.actors.runtime.actor import Header
from rampart.actors.runtime.run_plan import RunPlan
from rampart.sim.osmosis.trial.record import Judge, MissionRecord, MissionRecorder
from rampart.sim.osmosis.trial.report import render
from rampart.sim.runs.report import try_report

# Three points along x: taxi to 10, lights to 20, taxi to 30.
GOALS = (MissionGoal(10, 0, "taxi"), MissionGoal(20, 0, "light verification"),
         MissionGoal(30, 0, "taxi"))
MODES = {"T": "taxi", "L": "light verification", "-": ""}


def sample(time_s, x_m, mode="T", *, collisions=0, prohibited_s=0.0, obstacle_m=9.0, edge_m=2.0):
    truth = GroundTruth(Pose(x_m, 0.0, 0.0), Twist(0.0, 0.0), collisions, prohibited_s, obstacle_m,
                        edge_m, 1.0)
    return truth, MODES[mode], time_s


def judged(timeline: str):
    """One character a second is the mode reported while the robot drives on along x."""
    judge = Judge(GOALS)
    for second, mode in enumerate(timeline):
        judge.see(*sample(second, second, mode))
    return judge


def test_every_point_in_order_and_mode_is_a_success():
    #         0         10        20        30
    judge = judged("TTTTTTTTTTLLLLLLLLLLTTTTTTTTTTT")
    found = judge.verdict()
    assert (found.success, found.safe, found.reasons) == (True, True, ())
    assert judge.visit_times_s == [9.0, 19.0, 29.0]
    assert judge.point_m == math.inf


@pytest.mark.parametrize(("timeline", "visited", "reason"), [
        ("T" * 9, 0, "point 1 of 3 at (10, 0) was not reached, nearest 2.00 m"),
        ("-" * 31, 0, "point 1 of 3 at (10, 0) was not reached, nearest 0.00 m"),
        ("TTTTTTTTTTTTTTTTTTTTTTTTTTTTTTT", 1,
         "point 2 of 3 at (20, 0) was passed in mode 'taxi', not in 'light verification'"),
        ("LLLLLLLLLLLLLLLLLLLLTTTTTTTTTTT", 0,
         "point 1 of 3 at (10, 0) was passed in mode 'light verification', not in 'taxi'")])
def test_a_point_not_reached_or_reached_in_the_wrong_mode_is_a_failure(timeline, visited, reason):
    judge = judged(timeline)
    found = judge.verdict()
    assert (found.success, found.safe, found.reasons) == (False, True, (reason,))
    assert len(judge.visit_times_s) == visited


def test_a_collision_makes_unsafe_from_then_on_but_the_mission_may_succeed():
    judge = Judge(GOALS[:1])
    judge.see(*sample(0, 0))
    judge.see(*sample(1, 5, collisions=1))
    judge.see(*sample(2, 10, collisions=1))
    found = judge.verdict()
    assert (found.success, found.safe, judge.first_unsafe_s) == (True, False, 1)
    assert found.reasons == ("1 collision",)
    judge = Judge(GOALS[:1])
    judge.see(*sample(0, 10, prohibited_s=0.02))
    assert judge.verdict().reasons == ("0.02 s in the prohibited area",)
    assert not judge.verdict().safe


def test_the_closest_approaches_are_kept():
    judge = Judge(GOALS[:1])
    for second, (obstacle_m, edge_m) in enumerate([(3, 2), (0.4, 1.5), (5, 0.9)]):
        judge.see(*sample(second, second, obstacle_m=obstacle_m, edge_m=edge_m))
    assert (judge.obstacle_m, judge.prohibited_m, judge.narrowest_s) == (0.4, 0.9, 1)
    assert judge.point_m == 8


def test_without_ground_truth_nobody_knows_whether_it_was_safe():
    found = Judge(GOALS).verdict()
    assert (found.success, found.safe) == (False, None)
    assert found.reasons == ("no ground truth was received: the robot's position is unknown",)


# ---- the recorder, and what is written -----------------------------------------------------------

AIRPORT = load_airport("vallombre")
MISSION = AIRPORT.mission("AB")
ACTIVE, IDLE = fm.DetectionState.ACTIVE, fm.DetectionState.IDLE


class Story:
    """Feeds a recorder; `t` is the stamp of the next messages."""

    def __init__(self, run_id: str = "r1") -> None:
        self.recorder = MissionRecorder(RunPlan(run_id, seed=3), "safety-first", AIRPORT, MISSION)
        self.sequence = 0

    def tell(self, t_s: float, topic, message, source: str = "x", incarnation: int = 1) -> None:
        self.sequence += 1
        self.recorder.feed(topic, message, Header(source, incarnation, self.sequence, t_s))

    def truth(self, t_s: float, x_m: float, y_m: float, **more: float) -> None:
        fields = {"collisions": 0, "prohibited_s": 0.0, "obstacle_clearance_m": math.inf,
                  "prohibited_clearance_m": 2.0, "real_time_factor": 1.0} | more
        self.tell(t_s, topics.TRUTH, m.GroundTruth(
            m.Pose(x_m, y_m, 0.0), m.Twist(0.0, 0.0), **fields))

    def detect(self, t_s: float, name: str, state: fm.DetectionState, reason: str = "") -> None:
        self.tell(t_s, ftm_topics.DETECTION, fm.DetectionReport(state, reason, (), t_s), name)

    def mission(self, t_s: float, step: int, times_s: tuple[float, ...] = (), **more) -> None:
        self.tell(t_s, topics.MISSION_STATUS, m.MissionStatus(
            "1", "AB", m.MissionPhase.RUNNING, step, **{
                "goals": (), "step_times_s": times_s, "lights": (), "reason": "", **more}))

    def end(self, t_s: float = 100.0, *, mission="success", safety="safe",
            reasons=()) -> MissionRecord:
        return self.recorder.record(t_s, mission=mission, safety=safety, reasons=reasons)


def bars(run: MissionRecord) -> list[tuple[str, str, float, float]]:
    return [(i.lane, i.name, i.from_s, i.to_s) for i in run.intervals]


def test_the_track_and_its_length_are_the_truth_not_what_localization_believes():
    story = Story()
    for i in range(101):
        story.truth(i * 0.1, i * 0.1, 0.0)
        story.tell(i * 0.1, topics.POSE, m.Pose(i * 0.1, i * 0.05, 0.0))
    run = story.end()
    assert run.distance_m == pytest.approx(10.0, abs=0.3)
    assert all(y == 0 for _, _, y in run.track)
    assert run.believed[-1][2] == pytest.approx(5.0, abs=0.2)


def test_what_was_measured_and_reached_outlives_a_mission_manager_that_forgets():
    story = Story()
    light = m.LightMeasurement("A01", 200.0, 1.0, m.LightVerdict.OK)
    story.mission(12.5, 1, (12.0,), lights=(light,))
    story.mission(40.0, 2, (12.0, 27.5), lights=(light,))
    story.tell(50.0, topics.MISSION_STATUS, m.MissionStatus(
        "", "", m.MissionPhase.IDLE, 0, (), (), (), ""), incarnation=2)
    run = story.end()
    assert [s.reached_s for s in run.steps] == [12.5, 40.0, None, None, None]
    assert sum(light.verdict == "ok" for light in run.lights) == 1


def test_a_skipped_goal_is_not_reached():
    story = Story()
    story.mission(12.5, 1, (12.0,), skipped=(0,))
    story.mission(40.0, 2, (12.0, 27.5), skipped=(0,))
    run = story.end()
    assert [(s.reached_s, s.skipped) for s in run.steps[:3]] == [
        (None, True), (40.0, False), (None, False)]
    page = render(run)
    assert page.count(">skipped<") == 1
    assert "step 1 at" not in page


def test_crashes_detections_and_faults_are_bars_from_their_begin_to_their_end():
    story = Story()
    story.tell(4.0, bus_topics.INJECT, bm.Injection("i1", "localization/pose", "freeze", math.inf))
    for injection in ("i1", "gps-bias"):
        story.tell(5.0, bus_topics.INJECTION_REPORT, bm.InjectionReport(
            injection, "localization", 0, False, ""))
    crash = fm.ProcessEvent("localization", "crashed", 7, 1, "supervisor", "SIGKILL")
    story.tell(6.5, ftm_topics.PROCESS_EVENT, crash)
    story.tell(7.0, ftm_topics.PROCESS_EVENT, fm.ProcessEvent(
        "localization", "respawned", 9, 2, "RM4", ""))
    for t_s, name, state in ((11.0, "DM2", ACTIVE), (11.2, "DM2", ACTIVE), (12.0, "DM2", IDLE),
                             (12.2, "DM2", IDLE), (90.0, "DM1", ACTIVE)):
        story.detect(t_s, name, state, "why")
    story.tell(95.0, bus_topics.INJECTION_REPORT, bm.InjectionReport(
        "gps-bias", "localization", 40, True, ""))
    run = story.end(100.0)
    assert sorted(bars(run)) == [
        ("detection", "DM1", 90.0, 100.0), ("detection", "DM2", 11.0, 12.0),
        ("down", "localization", 6.5, 7.0),
        ("injection", "gps-bias", 5.0, 95.0), ("injection", "i1", 5.0, 7.0)]
    assert run.restarts == {"localization": 1}
    texts = [event.text for event in run.events]
    for text in ("localization crashed, incarnation 1: SIGKILL",
                 "localization respawned by RM4, incarnation 2",
                 "fault injected: freeze localization/pose at localization",
                 "fault injected: gps-bias at localization",
                 "injection over: gps-bias at localization, 40 messages changed"):
        assert text in texts


def full_story(run_id: str = "r1") -> Story:
    story = Story(run_id)
    for i in range(200):
        story.truth(i * 0.5, -20 + i * 0.2, -18.5, obstacle_clearance_m=0.5)
        story.tell(i * 0.5, topics.POSE, m.Pose(-20 + i * 0.2, -18.5 + i * 0.05, 0.0))
    for i, light in enumerate(AIRPORT.lights):
        verdict = (m.LightVerdict.OK, m.LightVerdict.DIM, m.LightVerdict.OUT)[i % 3]
        story.tell(9.0, topics.LIGHT_MEASURED, m.LightMeasurement(light.name, 10.0, 0.1, verdict))
    story.tell(3.0, topics.OBSTACLES, m.ObstacleList((
        m.ObstacleCommand("crate", True, 1.0, 2.0, 0.4),
        m.ObstacleCommand("gone", False, 1.0, 2.0, 0.4))))
    story.detect(20.0, "DM1", ACTIVE, "<script>alert(1)</script> & more")
    story.tell(20.1, ftm_topics.DECISION, fm.DecisionRecord(
        1, "safety-first", ("FTM1", "FTM6"), 2, ("RM1",), ("FTM1 > FTM6",),
        (("RM5", "FTM6 is dominated by FTM1"),), 20.0))
    return story


def test_the_page_is_self_contained_escaped_and_shows_everything():
    html = render(full_story().end(mission="fail", safety="unsafe", reasons=("went <astray>",)))
    assert "<script" not in html
    assert "&lt;script&gt;alert(1)&lt;/script&gt; &amp; more" in html
    assert "went &lt;astray&gt;" in html
    assert not re.search(r"""(src|href)=|url\((?!#)|@import|https?://""", html)
    for text in ("crate", "B11", "FTM1 &gt; FTM6", "RM5 (FTM6 is dominated by FTM1)",
                 "track by localization", "not safe"):
        assert text in html
    assert "gone" not in html


def test_a_report_that_cannot_be_written_leaves_the_old_one(tmp_path, monkeypatch):
    run = full_story("../../etc/x y").end()
    html, data, problem = try_report(run, render, tmp_path / "deep")
    assert (problem, sorted(html.parent.iterdir())) == ("", [html, data])
    assert msgspec.json.decode(data.read_bytes(), type=MissionRecord) == run
    before = html.read_text()
    monkeypatch.setattr("pathlib.Path.replace", no_space)
    assert "No space" in try_report(run, lambda _: "other", html.parent).problem
    assert (html.read_text(), sorted(html.parent.iterdir())) == (before, [html, data])


def no_space(*_):
    raise OSError(28, "No space left on device")


# ---- a run that is resumed ------------------------------------------------------------


def told_of_the_beginning(story: Story) -> None:
    goal = MISSION.goals[0]
    goals = tuple(m.Goal(g.x_m, g.y_m, m.Mode(g.mode)) for g in MISSION.goals)
    light = m.LightMeasurement("A01", 200.0, 1.0, m.LightVerdict.OK)
    story.mission(1.0, 0, goals=goals, lights=(light,))
    story.truth(10.0, goal.x_m - 5.0, goal.y_m, prohibited_clearance_m=0.4)
    story.truth(12.0, goal.x_m, goal.y_m)
    story.mission(12.5, 1, (12.0,), goals=goals, lights=(light,))
    story.detect(13.0, "DM4", ACTIVE, "dead")
    story.detect(14.0, "DM4", IDLE)
    story.tell(14.0, ftm_topics.PROCESS_EVENT, fm.ProcessEvent(
        "hmi", "respawned", 7, 2, "supervisor", ""))


def test_the_record_of_a_resumed_run_covers_both_parts_and_the_judge_knows_what_it_saw():
    before, after = Story(), Story()
    told_of_the_beginning(before)
    found = after.recorder.recall(before.recorder.memory(20.0))
    assert found.duration_s == 20.0
    goal = MISSION.goals[1]
    after.truth(40.0, goal.x_m, goal.y_m)  # the Mission Manager has not been heard again yet
    assert len(after.recorder.judge.visit_times_s) == 2, "judged in the mode of before the cut"
    after.tell(40.0, ftm_topics.PROCESS_EVENT, fm.ProcessEvent(
        "hmi", "respawned", 7, 2, "supervisor", ""))
    run = after.end(60.0)
    assert [step.reached_s for step in run.steps[:2]] == [12.5, None]
    assert next(x.intensity_cd for x in run.lights if x.name == "A01") == 200.0
    assert run.prohibited_clearance_m == 0.4
    assert [t for t, *_ in run.track] == [10.0, 12.0, 40.0]
    assert run.restarts == {"hmi": 2}
    assert ("detection", "DM4", 13.0, 14.0) in bars(run)
    assert any("cut off" in event.text for event in run.events)


def test_what_was_unsafe_before_a_cut_stays_so():
    unsafe, later = Story(), Story()
    unsafe.truth(5.0, 0.0, 0.0, collisions=1)
    later.recorder.recall(unsafe.recorder.memory(6.0))
    later.truth(9.0, 0.0, 0.0, collisions=0)
    verdict = later.recorder.judge.verdict()
    assert (verdict.safe, verdict.unsafe_s) == (False, 5.0)
