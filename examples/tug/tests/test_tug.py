"""The tug: its floor, its own detection module, its judge, and whole runs with faults."""

import asyncio
import random
import socket
import subprocess
from functools import cache
from pathlib import Path

import msgspec
import pytest
from tug import topics
from tug.judge import Deliveries
from tug.topics import Free, Goal, Motion, Place, Truth

from rampart import Header, parse_specification, verify
from rampart.testing import RealRun, VirtualSystem, run, table, virtual_run

HERE = Path(__file__).resolve().parents[1]
SYSTEM = HERE / "tug.toml"


@cache
def drive(*faults, ftm=True, seed=1):
    """Return what came of a run; the same one if asked again."""
    return virtual_run(SYSTEM, *faults, seed=seed, ftm=ftm)


def test_the_pilot_drives_no_faster_than_is_free_and_not_by_old_news():
    async def scenario():
        async with VirtualSystem.load(SYSTEM) as system:
            drives = system.hear(topics.DRIVE)
            system.start_node("pilot")
            await system.settle()
            for free_m, expected_mps in ((9.0, 0.8), (0.16, 0.4), (0.0, 0.0), (9.0, 0.8)):
                system.say(topics.MOTION, Motion(0.8, 0.0), source="controller")
                system.say(topics.FREE, Free(free_m, 0.5), source="world")
                await asyncio.sleep(0.1)
                assert drives[-1].message.speed_mps == pytest.approx(expected_mps)
            await asyncio.sleep(0.5)
            assert drives[-1].message == Motion(0.0, 0.0)

    run(scenario)


@pytest.mark.parametrize(("truths", "success", "safe"), **table({
    "nothing was heard": ([], False, None),
    "done": ([Truth(1.0, 0.9, 0.0, 0.5, 2)], True, True),
    "done, but not home": ([Truth(4.0, 0.9, 0.0, 0.5, 2)], False, True),
    "done, after it touched a shelf": (
        [Truth(4.0, 1.6, 0.5, 0.01, 1), Truth(1.0, 0.9, 0.0, 0.5, 2)], True, False),
    "too fast": ([Truth(4.0, 0.9, -1.4, 0.5, 1)], False, False),
}))
def test_the_judge(truths, success, safe):
    judge = Deliveries()
    for i, truth in enumerate(truths):
        judge.truth(truth, Header("world", 1, i, float(i)))
    verdict = judge.verdict()
    assert (verdict.success, verdict.safe) == (success, safe)
    assert bool(verdict.reasons) == (not (success and safe))
    assert (verdict.unsafe_s is None) == (safe is not False)


def test_it_delivers_everything_and_comes_home():
    done = drive()
    assert done.why == "all delivered, and home"
    assert done.judgement.success
    assert done.judgement.safe
    assert done.judgement.margins["gap"] > 0.3
    assert done.record.decisions == ()
    assert done.failures == ()


@pytest.mark.parametrize(("fault", "decided"), **table({
    "the controller dies": ("kill:controller@20", {"R_RESTART"}),
    "the mission dies with a trailer": ("kill:mission@20", {"R_RESTART"}),
    "the pilot dies": ("kill:pilot@20", {"R_RESTART_PILOT"}),
    "the pilot repeats itself": ("freeze:tug/drive@20+inf", {"R_RESTART_PILOT"}),
    "the pose is wrong for good": ("corrupt:localization/pose@20+inf", {"R_STOP", "R_RESTART"}),
    "the pilot drives backwards": ("corrupt:tug/drive@20+inf", {"R_BRAKE", "R_RESTART_PILOT"}),
    "the pilot drives on and on": ("stuck:tug/drive@20+inf", {"R_BRAKE", "R_RESTART_PILOT"}),
}))
def test_a_fault_is_recovered_from_and_the_work_is_done(fault, decided):
    done = drive(fault)
    assert done.judgement.success, done.judgement
    assert done.judgement.safe
    assert decided <= {name for d in done.record.decisions for name in d.recoveries}


def test_what_cannot_be_mended_is_safe_all_the_same():
    assert drive("corrupt:tug/free@20+inf").judgement.safe


def test_without_mechanisms_it_drives_into_a_wall():
    done = drive("kill:pilot@12", ftm=False)
    assert done.judgement.safe is False
    assert done.judgement.severity > 0


def test_its_specification_is_proved():
    spec = parse_specification(SYSTEM.read_text(encoding="utf-8"), "tug.toml")
    report = verify(spec, [spec.strategy])
    assert [p.name for p in report.properties if not p.holds] == []


@pytest.fixture(scope="module")
def controller():
    subprocess.run(["make", "--silent", "-C", str(HERE)], check=True)
    return HERE / "controller"


def told_in_c(controller, said):
    """Send messages to the program, and return its output: stamp and motion."""
    ours, its = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours, its:
        ours.settimeout(10)
        node = subprocess.Popen([str(controller)], pass_fds=[its.fileno()],
                                env={"RAMPART_SOCKET": str(its.fileno())})
        heard = []
        for topic, body, stamp in said:
            ours.send(f"{topic.key} {stamp!r} who 1\n".encode() + msgspec.json.encode(body))
            if topic is topics.POSE:
                heard.append(ours.recv(1000).split(b"\n", 1))
        ours.shutdown(socket.SHUT_RDWR)
        assert node.wait(10) == 0
    return [(float(head.split()[1]), msgspec.json.decode(body, type=Motion))
            for head, body in heard]


@pytest.mark.processes
def test_the_controller_in_c_says_what_its_stand_in_says(controller):
    chance = random.Random(7)

    def place():
        return chance.uniform(0, 8), chance.uniform(0, 6)

    said = []
    for i in range(300):
        if chance.random() < 0.3:
            said.append((topics.GOAL, Goal(i, *place(), chance.random() < 0.5), i * 0.1))
        said.append((topics.POSE, Place(*place(), chance.uniform(-4, 4), 0.5), i * 0.1))

    async def scenario():
        async with VirtualSystem.load(SYSTEM) as system:
            heard = system.hear(topics.MOTION)
            system.start_node("controller")
            await system.settle()
            for topic, body, stamp in said:
                await asyncio.sleep(max(0.0, stamp - system.clock.now()))
                system.say(topic, body, source="tests", stamp_s=stamp)
                await system.settle()
            return [(one.header.stamp, one.message) for one in heard]

    for (stamp, motion), (stamp_in_c, in_c) in zip(
            run(scenario), told_in_c(controller, said), strict=True):
        assert stamp_in_c == pytest.approx(stamp, abs=1e-8)
        assert in_c.speed_mps == pytest.approx(motion.speed_mps, abs=1e-8)
        assert in_c.turn_radps == pytest.approx(motion.turn_radps, abs=1e-8)


@pytest.mark.processes
@pytest.mark.usefixtures("controller")
def test_on_processes_the_controller_is_back(tmp_path):
    with RealRun(tmp_path, SYSTEM, "--duration", "30") as real:
        real.sleep_until(3)
        old = real.kill("controller")
        real.wait_until(lambda: real.pid("controller") not in (None, old), 10, "it is not back")
