"""Metrics and live views: what they make of a run, and one clear line if a library is missing."""

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
from prometheus_client import exposition, parser

from rampart.actors.bus.envelope import Header
from rampart.actors.bus.run_info import RunInfo
from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.machine.process_usage import ProcessCount
from rampart.actors.runtime.clock import Clock
from rampart.cli import run_picture, session
from rampart.cli.look import live_metrics
from rampart.cli.look.live_foxglove import _watch
from rampart.cli.look.live_metrics import Exposition, families
from rampart.cli.run_picture import RunPicture
from rampart.testing import free_port
from tests import ROOT
from tests.cli.look.test_top import busy

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
