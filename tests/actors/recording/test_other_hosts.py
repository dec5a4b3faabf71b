"""What the recording of one host has of the others: each message once, and when none was heard."""

from __future__ import annotations

import json
import os
import time

import msgspec
import pytest
import zenoh

from rampart.actors.bus import run_folder
from rampart.actors.bus.envelope import Header, encode
from rampart.actors.bus.messages import Heartbeat
from rampart.actors.bus.recorder_connection import RecorderConnection
from rampart.actors.bus.topics import HEARTBEAT
from rampart.actors.bus.zenoh_session import endpoint, session_config
from rampart.actors.recording.bag_reader import BagReader, Summary, key_of, repair
from rampart.actors.recording.bag_writer import SILENT, BagWriter, SequenceGaps
from rampart.actors.recording.other_hosts import (
    MOST_SILENCES,
    EachOnce,
    OtherHosts,
    Silences,
    distinct,
    others_of,
)
from rampart.actors.recording.recorder import Recorder
from rampart.actors.runtime.run_plan import RunPlan, load_system
from rampart.actors.system.layout import Layout
from rampart.testing import wait_until
from tests.actors.recording.samples import AnsweringLauncher, documents, pose, running
from tests.two_hosts import two_hosts

GUARDS = {"ground": ("supervisor_ground", "router_a_ground")}
OTHERS = OtherHosts(("rampart/heartbeat/*",), GUARDS, 0.6)
BEAT = Heartbeat(1, 2, 0.1, 0, 0)


def beat(source: str, sequence: int, at_s: float = 0.0, incarnation: int = 1):
    header = Header(source, incarnation, sequence, at_s)
    return at_s, HEARTBEAT.at(source), encode(header, BEAT)


# ---- what is heard ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def hosts(tmp_path_factory):
    file = tmp_path_factory.mktemp("hosts") / "two.toml"
    file.write_text(two_hosts({"robot": "10.0.0.1", "ground": "10.0.0.2"}), encoding="utf-8")
    plan = RunPlan(system_file=str(file))
    spec = load_system(plan)
    return {name: others_of(Layout(msgspec.structs.replace(plan, host=host), spec))
            for name, host in (("robot", ""), ("ground", "ground"))}


def test_the_first_host_hears_all_that_nodes_guards_and_people_there_may_say(hosts):
    heard = hosts["robot"].keys

    def is_heard(key: str) -> bool:
        return any(zenoh.KeyExpr(one).includes(f"rampart/{key}") for one in heard)

    for key in ("heartbeat/hmi", "diagnostic/DM5", "detection/DM5", "teleoperation/command",
                "supervisor/supervisor_ground/nodes", "heartbeat/router_b_ground",
                "heartbeat/observer_ground", "manager/reset", "inject/order", "supervisor/event"):
        assert is_heard(key), key
    for key in ("summit_xl/command", "detection/DM4", "heartbeat/DM4", "supervisor/nodes",
                "localization/pose", "gone/hmi/1"):
        assert not is_heard(key), key
    assert hosts["robot"].guards == {
        "ground": ("supervisor_ground", "router_a_ground", "router_b_ground")}


def test_the_other_host_hears_what_the_first_may_say(hosts):
    assert {"rampart/detection/DM4", "rampart/summit_xl/command"} <= set(hosts["ground"].keys)
    assert hosts["ground"].guards == {"robot": ("supervisor", "router_a", "router_b")}


def test_no_key_is_heard_twice(hosts):
    for other in hosts.values():
        parsed = [zenoh.KeyExpr(one) for one in other.keys]
        assert not [(one, two) for i, one in enumerate(parsed) for two in parsed[:i]
                    if one.intersects(two)]


def test_a_system_of_one_host_has_nothing_to_hear():
    plan = RunPlan(system_file=documents().plan["system_file"])
    assert others_of(Layout(plan, load_system(plan))) is None


def test_too_many_keys_are_heard_as_one():
    assert distinct({"a/*", "a/b", "a/c/d", "x"}) == ("a/*", "a/c/d", "x")
    assert distinct({f"rampart/heartbeat/node_{n}" for n in range(5000)}) == ("rampart/**",)


# ---- each once ----------------------------------------------------------------------------------


def test_what_was_handed_over_here_is_left_out_of_what_came_by_the_bus():
    once = EachOnce()
    here, far = [beat("pilot", 7), (0.0, "k", b"\xc1")], [beat("hmi", 3), (0.0, "k", b"\xc2")]
    once.handed_over(here)
    assert list(once.from_elsewhere([*here, *far])) == [(far[0], "hmi"), (far[1], "")]


def test_a_node_that_was_taken_over_is_heard_here_and_the_one_that_goes_on_there_from_there():
    once = EachOnce()
    once.handed_over([beat("hmi", 1, incarnation=1_000_001)])
    both = [beat("hmi", 2, incarnation=1_000_001), beat("hmi", 900, incarnation=1)]
    assert [frame for frame, _ in once.from_elsewhere(both)] == both[1:]


@pytest.mark.parametrize(("heard", "lost"), [
    ([1, 2, 4, 3], {}), ([1, 5, 2, 4], {"a": 1}), ([1, 5, 2, 2, 2], {"a": 2}),
    ([3, 3, 1], {"a": 1}), ([1, 900_000, 899_999], {"a": 899_997})])
def test_what_is_only_overtaken_on_its_way_is_not_lost(heard, lost):
    gaps = SequenceGaps(from_start=True)
    for number in heard:
        gaps.add(Header("a", 1, number, 0.0))
    assert gaps.lost() == lost


# ---- when nothing is heard ----------------------------------------------------------------------


def spans(silences: Silences) -> list[list[float | None]]:
    return json.loads(silences.record(lambda at_s: at_s)["ground"])


def test_a_partition_is_told_from_the_last_message_to_the_next():
    silences = Silences(OTHERS, 0.0)
    silences.received("supervisor_ground", 0.5)
    silences.look(1.0)
    assert spans(silences) == []
    silences.look(1.2)
    assert spans(silences) == [[0.5, None]]
    silences.received("hmi", 3.0)  # it may run here by now: only guards are that host
    assert spans(silences) == [[0.5, None]]
    silences.received("router_a_ground", 4.0)
    silences.received("router_a_ground", 4.1)
    silences.look(4.2)
    assert spans(silences) == [[0.5, 4.0]]


def test_one_that_nobody_looked_at_meanwhile_is_told_too():
    silences = Silences(OTHERS, 0.0)
    silences.received("supervisor_ground", 0.1)
    silences.received("supervisor_ground", 9.0)
    assert spans(silences) == [[0.1, 9.0]]


def test_a_host_that_is_never_heard_is_told_from_the_beginning():
    silences = Silences(OTHERS, 2.0)
    silences.look(100.0)
    assert spans(silences) == [[2.0, None]]


def test_a_link_that_flaps_all_the_time_does_not_fill_the_memory():
    silences = Silences(OTHERS, 0.0)
    for second in range(1, 1000):
        silences.look(second - 0.1)
        silences.received("supervisor_ground", float(second))
    told = spans(silences)
    assert len(told) == MOST_SILENCES
    assert told[-1][1] == 999.0  # it covers what follows


def test_the_file_tells_it_also_when_it_is_torn_and_repaired(tmp_path):
    path = tmp_path / "run.mcap"
    writer = BagWriter(path.open("wb"), documents(), from_start=True)
    for record in ({"ground": "[]"}, {"ground": "[[1.0,null]]"}, {"ground": "[[1.0,2.5]]"}):
        writer.write_silences(record)
        writer.write_silences(record)
        writer.take(*pose(1, 0.0))
    writer.flush()
    writer.abandon()  # it has no end
    assert Summary(BagReader(path)).unheard == {"ground": [(1.0, 2.5)]}
    repair(BagReader(path), tmp_path / "whole.mcap")
    summary = Summary(BagReader(tmp_path / "whole.mcap"))
    assert (summary.unheard, summary.reader.closed) == ({"ground": [(1.0, 2.5)]}, True)


@pytest.mark.parametrize("text", [
    "", "nonsense", "[[1]]", '{"a": 1}', "[" * 100_000, "[[1, 2, 3]]"])
def test_what_makes_no_sense_in_a_file_is_left_out(tmp_path, text):
    path = tmp_path / "run.mcap"
    writer = BagWriter(path.open("wb"), documents())
    writer.write_silences({"ground": text, "moon": "[]"})
    writer.close()
    assert Summary(BagReader(path)).unheard == {"moon": []}


# ---- the recorder -------------------------------------------------------------------------------


@pytest.mark.processes
def test_the_recorder_writes_what_comes_by_the_bus_and_tells_when_nothing_does(port, tmp_path):
    path = tmp_path / "run.mcap"
    folder = run_folder.make(port, os.getpid())
    recorder = Recorder(port, path, launcher=os.getpid(), others=OTHERS)
    router = zenoh.open(session_config([endpoint(folder, "router_a")], []))
    origin_s = time.monotonic()
    try:
        with AnsweringLauncher(port, origin_s) as launcher:
            launcher.info = msgspec.structs.replace(launcher.info, folder=folder)
            recorder.open()
            here = RecorderConnection(port)
            sent = {"pilot": 0, "hmi": 0, "supervisor_ground": 0}

            def send(*names: str) -> None:
                for name in names:
                    sent[name] += 1
                    _, key, payload = beat(name, sent[name], time.monotonic() - origin_s)
                    router.put(key, payload)
                    if name == "pilot":
                        here.take(key, payload)

            def heard() -> bool:
                send("pilot", "supervisor_ground")
                time.sleep(0.02)
                writer = recorder.writer
                return writer is not None and writer.silences == {"ground": "[]"}

            with running(recorder):
                wait_until(heard, 10, "the other host is not heard")
                for _ in range(50):
                    send("pilot", "hmi", "supervisor_ground")
                wait_until(lambda: "null" in recorder.writer.silences["ground"], 10, "no silence")
                send("supervisor_ground")
                wait_until(lambda: "null" not in recorder.writer.silences["ground"], 10,
                           "no end of it")
            here.close()
    finally:
        router.close()
        run_folder.remove(folder)
    reader = BagReader(path)
    found = [(key_of(channel), message.sequence, message.log_time)
             for channel, message in reader.messages() if key_of(channel)]
    assert [n for key, n, _ in found if key == HEARTBEAT.at("pilot")] == list(
        range(1, sent["pilot"] + 1))  # not twice, though they came by the bus as well
    assert [n for key, n, _ in found if key == HEARTBEAT.at("hmi")] == list(range(1, 51))
    assert [at for _, _, at in found] == sorted(at for _, _, at in found)
    summary = Summary(BagReader(path))
    [span] = summary.unheard["ground"]
    assert 0.6 < span[1] - span[0] < 5
    lost = json.loads(summary.end["lost"])
    assert set(lost) <= {"supervisor_ground"}  # what it sent before it was listened to
    assert SILENT in summary.reader.metadata
