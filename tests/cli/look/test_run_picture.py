"""What tools make of a run: screens of any size, lines, metrics and live views."""

from __future__ import annotations

import asyncio
import os
import re
import signal
import socket
import sys
from argparse import Namespace
from types import SimpleNamespace

import httpx
import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from prometheus_client import exposition, parser
from rich.cells import cell_len
from rich.console import Console

from rampart.actors.bus.envelope import Header
from rampart.actors.bus.run_info import RunInfo
from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.machine.process_usage import ProcessCount
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.runtime.clock import Clock
from rampart.cli import run_picture, session
from rampart.cli.look import live_metrics
from rampart.cli.look.live_foxglove import _watch
from rampart.cli.look.live_metrics import Exposition, families
from rampart.cli.look.top import Frame, screen
from rampart.cli.osmosis.lines import OsmosisLines
from rampart.cli.run_picture import RunPicture
from rampart.testing import free_port
from tests import ROOT

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


WHEELS = (0.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize(("stopped", "brake", "words"), [
    (False, None, "driving"), (False, False, "driving"), (True, False, "STOPPED"),
    (False, True, "BRAKED"), (True, True, "BRAKED")])
def test_a_robot_that_is_braked_is_not_said_to_be_driving(stopped, brake, words):
    latest = {topics.PILOT_STATUS.key: m.PilotStatus(m.PilotMode.AUTO, stopped, "", 0)}
    if brake is not None:
        latest[topics.BASE_STATUS.key] = m.BaseStatus(brake, False, 0.0, WHEELS)
    lines = dict(OsmosisLines().status(lambda topic: latest.get(topic.key), {}, ()))
    assert lines["pilot"] == f"auto, {words}"


RUN = RunInfo(1, 7450, 1.0, 0.0, "paper.toml", "", (), "run", 0, 'a "title"\\ and\nmore')


@pytest.mark.parametrize(("module", "arguments", "extra"), [
    ("prometheus_client.exposition", ["metrics"], "prometheus"),
    ("foxglove", ["live", "foxglove"], "foxglove")])
def test_a_missing_extra_is_one_line_that_says_what_to_install(
        module, arguments, extra, monkeypatch, refused):
    monkeypatch.setitem(sys.modules, module, None)
    assert f"pip install 'rampart-robot[{extra}]'" in refused(*arguments)


def test_an_address_that_is_none_or_taken_is_named(refused):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        for arguments in (["metrics", "--port", port], ["live", "foxglove", "--port", port],
                          ["metrics", "--port", "99999"], ["live", "foxglove", "--port", "-1"],
                          ["metrics", "--host", "nobody.invalid"]):
            assert arguments[-1] in refused(*arguments)


def exposed(now):
    return exposition.generate_latest(SimpleNamespace(collect=lambda: families(now))).decode()


def test_a_run_becomes_the_metrics_that_the_handbook_lists():
    picture = busy()
    for topic, body in (
            (ftm_topics.NODES, fm.NodeTable((fm.NodeInfo(
                "hmi", "support", 1, fm.NodeState.CRASHED, 1, 0, heard_s=0.5),))),
            (ftm_topics.RECOVERY, fm.RecoveryReport(
                fm.RecoveryState.ACTIVATED, fm.RecoveryPhase.ACTING, 1, ""))):
        picture.heard(topic, Header("somebody", 1, 1, 1.0), body, 1.0)
    text = exposed(Exposition(RUN, 10.5, picture, {"hmi": ProcessCount(2.5, 4096, 1.0)}))
    samples = {s.name: s for f in parser.text_string_to_metric_families(text) for s in f.samples}
    assert samples["rampart_run_info"].labels["title"] == RUN.title
    assert {name: samples[f"rampart_{name}"].value for name in (
        "simulated_seconds", "process_cpu_seconds_total", "node_up", "recovery_activated")} == {
            "simulated_seconds": 10.5, "process_cpu_seconds_total": 2.5, "node_up": 0.0,
            "recovery_activated": 1.0}
    assert 'rampart_detections_total{module="DM7"} 1.0' in text
    assert "rampart_up 1.0" in exposed(Exposition(RUN, 0.0, RunPicture()))  # nothing arrived yet
    found = {name: set(sample.labels) for name, sample in samples.items()}
    listed = {}
    for line in (ROOT / "docs/how-to/terminal.md").read_text("utf-8").splitlines():
        if line.startswith("| `rampart_") and "with credentials only" not in line:
            _, names, labels, _ = line.split("|")
            for name in re.findall(r"`(?:rampart)?_(\w+)`", names):
                listed[f"rampart_{name}"] = set(re.findall(r"\w+", labels))
    assert listed == found


@pytest.mark.parametrize("replay_of", ["", "run.mcap"])
async def test_guards_are_looked_for_whether_or_not_somebody_asks_and_never_on_a_replay(
        monkeypatch, replay_of):
    run = msgspec.structs.replace(RUN, pid=os.getpid(), replay_of=replay_of)
    mine = fm.NodeTable((
        fm.NodeInfo("hmi", "operator", os.getpid(), fm.NodeState.RUNNING, 1, 0),
        fm.NodeInfo("far", "operator", os.getpid(), fm.NodeState.RUNNING, 1, 0, host="ground")))
    looks = []

    async def one(*_, **__):
        yield SimpleNamespace(run=run, clock=Clock(0.0))

    class Observer:
        def __init__(self, *_) -> None:
            pass

        def look(self, table):
            looks.append(table)
            return {"nodes": {}, "guards": [{"name": f"guard_{len(looks)}", "pid": os.getpid()}]}

    monkeypatch.setattr(live_metrics, "sessions", one)
    monkeypatch.setattr(run_picture, "ProcessObserver", Observer)
    monkeypatch.setattr(live_metrics, "LOOK_S", 0.001)
    monkeypatch.setattr(run_picture, "draw", lambda _session, picture: picture.heard(
        ftm_topics.NODES, Header("supervisor", 1, 1, 0.0), mine, 0.0))
    exporter, stop = live_metrics.Exporter(), asyncio.Event()
    task = asyncio.create_task(exporter.follow(None, stop))
    async with asyncio.timeout(10):
        while not (looks or (replay_of and exporter.look())):
            await asyncio.sleep(0.001)
    seen = len(looks)
    assert set(exporter.look().processes) == (set() if replay_of else {"hmi", f"guard_{seen}"})
    assert len(looks) == seen
    stop.set()
    await task
    assert bool(looks) != bool(replay_of)


async def test_prometheus_is_answered_without_a_run(monkeypatch):
    monkeypatch.setattr(session, "find_runs", list)
    port = free_port()
    serving = asyncio.create_task(live_metrics.metrics(
        Namespace(host="127.0.0.1", port=port, of=None)))
    async with httpx.AsyncClient(transport=httpx.AsyncHTTPTransport(retries=5)) as client:
        answer = await client.get(f"http://127.0.0.1:{port}/metrics")
    assert (answer.status_code, answer.text.splitlines()[-1]) == (200, "rampart_up 0.0")
    os.kill(os.getpid(), signal.SIGTERM)
    assert await serving == 0
    with pytest.raises(ConnectionError):
        await asyncio.open_connection("127.0.0.1", port)


def test_live_views_show_the_robot_as_large_as_the_system_says(tmp_path):
    paper = (ROOT / "systems" / "paper.toml").read_text()
    system = tmp_path / "system.toml"
    system.write_text(paper.replace("length_m = 0.72", "length_m = 0.8"))
    for file, views in ((system, {"view/robot", "view/map", "view/lights"}),
                        (tmp_path / "none.toml", set())):
        shown = {}
        viewer = SimpleNamespace(begin=lambda _run, _channels: None,
                                 show=lambda channel, record, _at, to=shown: to.update(
                                     {channel: record}))
        _watch(SimpleNamespace(run=msgspec.structs.replace(RUN, system_file=str(file)),
                               clock=Clock(0.0), listen=lambda *_: None), viewer)
        assert set(shown) == views
        for robot in [shown[v] for v in shown if v == "view/robot"]:
            box = robot.entities[0].cubes[0].size
            assert (box.x, box.y) == (0.8, 0.614)
