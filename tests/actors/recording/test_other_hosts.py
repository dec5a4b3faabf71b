"""What the recording of one host has of the others: each message once."""

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
from rampart.actors.recording.bag_reader import BagReader, Summary, key_of
from rampart.actors.recording.recorder import EachOnce, Recorder, distinct, keys_elsewhere
from rampart.actors.runtime.run_plan import RunPlan, load_system
from rampart.actors.system.layout import Layout
from rampart.testing import wait_until
from tests.actors.recording.samples import PLAN, AnsweringLauncher, running
from tests.two_hosts import two_hosts

BEAT = Heartbeat(1, 2, 0.1, 0, 0)


def beat(source: str, sequence: int, at_s: float = 0.0, incarnation: int = 1):
    header = Header(source, incarnation, sequence, at_s)
    return at_s, HEARTBEAT.at(source), encode(header, BEAT)


@pytest.fixture(scope="module")
def heard(tmp_path_factory):
    """By host, the keys that it subscribes to."""
    file = tmp_path_factory.mktemp("hosts") / "two.toml"
    file.write_text(two_hosts({"robot": "10.0.0.1", "ground": "10.0.0.2"}), encoding="utf-8")
    plan = RunPlan(system_file=str(file))
    spec = load_system(plan)
    return {name: keys_elsewhere(Layout(msgspec.structs.replace(plan, host=host), spec))
            for name, host in (("robot", ""), ("ground", "ground"))}


def test_each_host_hears_what_nodes_guards_and_people_of_the_other_may_say_once(heard):
    def is_heard(key: str) -> bool:
        return any(zenoh.KeyExpr(one).includes(f"rampart/{key}") for one in heard["robot"])

    for key in ("heartbeat/hmi", "diagnostic/DM5", "detection/DM5", "teleoperation/command",
                "supervisor/supervisor_ground/nodes", "heartbeat/router_b_ground",
                "heartbeat/observer_ground", "manager/reset", "inject/order", "supervisor/event"):
        assert is_heard(key), key
    for key in ("summit_xl/command", "detection/DM4", "heartbeat/DM4", "supervisor/nodes",
                "localization/pose", "gone/hmi/1"):
        assert not is_heard(key), key
    assert {"rampart/detection/DM4", "rampart/summit_xl/command"} <= set(heard["ground"])
    for keys in heard.values():
        parsed = [zenoh.KeyExpr(one) for one in keys]
        assert not [(one, two) for i, one in enumerate(parsed) for two in parsed[:i]
                    if one.intersects(two)]


def test_a_system_of_one_host_has_nothing_to_hear_and_too_many_keys_are_heard_as_one():
    plan = RunPlan(system_file=PLAN["system_file"])
    assert keys_elsewhere(Layout(plan, load_system(plan))) == ()
    assert distinct({"a/*", "a/b", "a/c/d", "x"}) == ("a/*", "a/c/d", "x")
    assert distinct({f"rampart/heartbeat/node_{n}" for n in range(5000)}) == ("rampart/**",)


def test_what_was_handed_over_here_is_left_out_of_what_came_by_the_bus():
    once = EachOnce()
    here, far = [beat("pilot", 7), (0.0, "k", b"\xc1")], [beat("hmi", 3), (0.0, "k", b"\xc2")]
    once.handed_over([*here, beat("arm", 1, incarnation=1_000_001)])
    taken_over, goes_on = beat("arm", 2, incarnation=1_000_001), beat("arm", 900)
    assert list(once.from_elsewhere([*here, *far, taken_over, goes_on])) == [*far, goes_on]


@pytest.mark.processes
def test_the_recorder_writes_what_comes_by_the_bus_once_and_in_order(port, tmp_path):
    path = tmp_path / "run.mcap"
    folder = run_folder.make(port, os.getpid())
    recorder = Recorder(port, path, launcher=os.getpid(), elsewhere=("rampart/heartbeat/*",))
    router = zenoh.open(session_config([endpoint(folder, "router_a")], []))
    origin_s = time.monotonic()
    try:
        with AnsweringLauncher(port, origin_s) as launcher:
            launcher.info = msgspec.structs.replace(launcher.info, folder=folder)
            recorder.open()
            here = RecorderConnection(port)
            listened = router.declare_publisher(HEARTBEAT.at("hmi"))
            with running(recorder):
                wait_until(lambda: listened.matching_status.matching, 10, "nobody listens")
                for number in range(1, 51):
                    for name in ("pilot", "hmi"):
                        _, key, payload = beat(name, number, time.monotonic() - origin_s)
                        router.put(key, payload)
                        if name == "pilot":
                            here.take(key, payload)
                wait_until(lambda: recorder.messages >= 100, 10, "they are not recorded")
            here.close()
    finally:
        router.close()
        run_folder.remove(folder)
    reader = BagReader(path)
    found = [(key_of(channel), message.sequence, message.log_time)
             for channel, message in reader.messages() if key_of(channel)]
    for name in ("pilot", "hmi"):  # none twice, though the pilot's came by the bus as well
        assert [n for key, n, _ in found if key == HEARTBEAT.at(name)] == list(range(1, 51))
    assert [at for _, _, at in found] == sorted(at for _, _, at in found)
    assert json.loads(Summary(BagReader(path)).end["lost"]) == {}
