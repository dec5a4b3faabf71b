"""`rampart top` without a terminal: what a picture of the run becomes on screens of any size."""

from __future__ import annotations

from types import SimpleNamespace

from hypothesis import given
from hypothesis import strategies as st
from rich.cells import cell_len
from rich.console import Console

from rampart.actors.bus.envelope import Header
from rampart.actors.bus.run_info import RunInfo
from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.runtime.clock import Clock
from rampart.cli.look.top import Frame, screen
from rampart.cli.osmosis.lines import OsmosisLines
from rampart.cli.run_picture import RunPicture, draw
from rampart.systems import DEFAULT

MISSION = m.MissionStatus(
    "id", "AB", m.MissionPhase.RUNNING, 1,
    tuple(m.Goal(x, 0.0, m.Mode.TAXI) for x in (1.0, 2.0, 3.0)), (1.0,), (), "")
CRASH = fm.DecisionRecord(4, "safety-first", ("FTM4",), 1, ("RM3",), ("FTM4",), (), 1.0)
NODES = fm.NodeTable((
    fm.NodeInfo("mission_manager", "control", 11, fm.NodeState.RUNNING, 1, 0),
    fm.NodeInfo("localization", "control", 12, fm.NodeState.CRASHED, 3, 2),
    fm.NodeInfo("hmi", "operator", 13, fm.NodeState.RUNNING, 1, 0)))
MANAGER = fm.ManagerStatus(("FTM4",), (), ("RM3",), ("RM1",), "safety-first", 4)
TRUTH = m.GroundTruth(m.Pose(0, 0, 0), m.Twist(0, 0), 0, 0.0, 2.5, 1.25, 1.0)
USAGE = {"mission_manager": {"cpu": 1.0, "mb": 60.0, "age_s": 75.0},
         "localization": {"cpu": 2.0, "mb": 61.0, "age_s": 3700.0, "late_s": 0.0},
         "hmi": {"cpu": 9.0, "mb": 62.0, "age_s": 4.0}}


def told(picture: RunPicture, topic, body, source: str = "somebody", now_s: float = 10.0) -> None:
    picture.heard(topic, Header(source, 1, 1, now_s), body, now_s)


def busy() -> RunPicture:
    picture = RunPicture(OsmosisLines())
    told(picture, topics.MISSION_STATUS, MISSION)
    told(picture, topics.POSE, m.Pose(1.5, -2.0, 1.5708))
    told(picture, topics.PILOT_STATUS, m.PilotStatus(m.PilotMode.STOP, True, "RM1: brake", 0))
    told(picture, ftm_topics.MANAGER_STATUS, MANAGER)
    told(picture, ftm_topics.NODES, NODES)
    told(picture, topics.TRUTH, TRUTH)
    told(picture, ftm_topics.DETECTION, fm.DetectionReport(
        fm.DetectionState.ACTIVE, "localization crashed", ("localization",), 9.0), "DM7")
    told(picture, ftm_topics.DETECTION,
         fm.DetectionReport(fm.DetectionState.IDLE, "", (), 0.0), "DM1")
    told(picture, ftm_topics.DECISION, CRASH)
    return picture


def frame(picture: RunPicture, **changes) -> Frame:
    return Frame(**{"title": "AB on Vallombre", "port": 7450, "rate": 1.0, "time_s": 10.5,
                    "picture": picture, "usage": USAGE, **changes})


def shown_in(frame: Frame, width: int = 80) -> list[str]:
    console = Console(width=width, height=24)
    with console.capture() as captured:
        console.print(screen(frame, width))
    return captured.get().splitlines()


def line_of(shown: list[str], label: str) -> str:
    return next(line for line in shown if line.startswith(label))


def test_a_screen_of_80_by_24_shows_what_matters_and_troubles_first():
    shown = shown_in(frame(busy()))
    assert len(shown) <= 24
    assert "AB running, step 2 of 3" in line_of(shown, "mission ")
    assert "x 1.50 m  y -2.00 m  heading 90 deg" in line_of(shown, "robot")
    assert "stop, STOPPED: RM1: brake" in line_of(shown, "pilot")
    assert "safe so far; nearest obstacle 2.50 m" in line_of(shown, "safety")
    assert "ACTIVE FTM4; recovery RM3; latched RM1" in line_of(shown, "manager")
    assert "1 of 2: DM7 localization crashed" in line_of(shown, "detection")
    assert "4: RM3: FTM4, because" in line_of(shown, "decisions")
    assert line_of(shown, "localization").split() == [
        "localization", "crashed", "3", "2", "1h01m", "2%", "61"]
    names = [line.split()[0] for line in shown]
    assert [name for name in names if name in USAGE] == ["localization", "mission_manager", "hmi"]


def test_whoever_has_fallen_silent_is_named():
    shown = shown_in(frame(busy(), time_s=20.0))
    assert "SILENT for 10 s; last: AB running" in line_of(shown, "mission ")
    assert "SILENT" in line_of(shown, "manager")
    nothing = shown_in(frame(RunPicture(OsmosisLines()), usage={}))
    assert line_of(nothing, "mission ").split() == ["mission", "silent"]


@given(st.integers(20, 250), st.text(max_size=30))
def test_every_screen_fits_and_no_words_move_the_cursor(width, words):
    picture = busy()
    told(picture, topics.PILOT_STATUS, m.PilotStatus(m.PilotMode.AUTO, False, words, 0))
    for second in range(3):
        for topic in topics.ALL:
            picture.count(topic)
        picture.sample(float(second))
    shown = shown_in(frame(picture, title=words, recording=words), width)
    assert all(line.isprintable() and cell_len(line) <= width for line in shown)
    assert any("control/com" in line for line in shown) == (width >= 80)


def test_an_activity_is_counted_when_it_begins():
    picture = RunPicture(OsmosisLines())
    for state in ("active", "active", "idle", "active"):
        told(picture, ftm_topics.DETECTION,
             fm.DetectionReport(fm.DetectionState(state), "", (), 0.0), "DM1")
    for state in ("idle", "activated", "activated"):
        told(picture, ftm_topics.RECOVERY, fm.RecoveryReport(
            fm.RecoveryState(state), fm.RecoveryPhase.ACTING, 1, ""), "RM1")
    assert (picture.detections_total["DM1"], picture.recoveries_total["RM1"]) == (2, 1)


def test_every_topic_is_either_read_or_counted():
    read, counted, picture = [], [], RunPicture()
    draw(SimpleNamespace(
        run=RunInfo(1, 7450, 1.0, 0.0, str(DEFAULT), "", (), "run", 0, ""), clock=Clock(0.0),
        listen=lambda topic, *_: read.append(topic),
        overhear=lambda topic, *_: counted.append(topic)), picture)
    assert {t.key for t in read} >= {topics.POSE.key, ftm_topics.NODES.key}
    assert sorted(t.key for t in (*read, *counted)) == sorted(t.key for t in topics.ALL)
    assert isinstance(picture.lines, OsmosisLines)
