"""What is given up on is tried again as long as the run lasts, and meanwhile the robot stands."""

from __future__ import annotations

import asyncio
from functools import partial
from itertools import pairwise

import msgspec
import pytest

from rampart.actors.detection.freshness import Freshness
from rampart.actors.ftm import topics
from rampart.actors.ftm.messages import AdaptedSystem
from rampart.actors.osmosis.control.pilot.safety_pilot import SafetyPilot
from rampart.actors.runtime.actor import Actor
from rampart.actors.runtime.run_plan import load_document
from rampart.actors.supervision.supervised_process import Lives, RestartPolicy
from rampart.manager.actor import FtmManager
from rampart.manager.spec.adaptation import Action, Change, adapt
from rampart.manager.spec.nodes import RestartLimits
from rampart.manager.spec.tables import Supervision
from rampart.sim.campaign.job import Job, run_virtually
from rampart.sim.faults.scenario import parse_fault
from rampart.testing import eventually
from tests import ROOT
from tests.actors.supervision.test_supervisor import PLAN
from tests.actors.supervision.test_supervisor import running as played
from tests.virtual_time import within
from tests.whole.missions import write_short_mission

SICK_S = (14.0, 40.0)
"""Simulated seconds, far longer than it takes to be given up."""

SOON = Supervision(intensity=8, period_s=6.0, backoff_max_s=0.2, attempt_s=1.0, attempt_max_s=4.0)
"""A supervisor that gives up sooner than the usual one."""


class Sick(Actor):
    """Fails whenever it starts, for a while, and is well after it."""

    def on_start(self) -> None:
        if SICK_S[0] <= self.clock.now() < SICK_S[1]:
            raise RuntimeError("sick")
        super().on_start()


class SickPilot(Sick, SafetyPilot):
    pass


class SickModule(Sick, Freshness):
    pass


class SickManager(Sick, FtmManager):
    pass


def restarts_of(
    policy: RestartPolicy, until_s: float, lasts_s: float = 0.0
) -> list[tuple[float, bool]]:
    """Return when a process that always lasts so long is restarted, and whether by an attempt."""
    now_s, restarts = 0.0, []
    while now_s < until_s:
        delay_s = policy.delay_s(now_s)
        is_attempt = delay_s is None
        now_s += policy.attempt_in_s(now_s) if delay_s is None else delay_s
        policy.restarted(now_s)
        restarts.append((now_s, is_attempt))
        now_s += lasts_s
    return restarts


def test_attempts_begin_when_the_window_has_room_and_come_further_and_further_apart():
    restarts = restarts_of(RestartPolicy(), 24 * 3600)
    free = [at_s for at_s, is_attempt in restarts if not is_attempt]
    attempts = [at_s for at_s, is_attempt in restarts if is_attempt]
    assert len(free) == 50
    assert attempts[0] == pytest.approx(free[0] + 60)
    gaps = [b - a for a, b in pairwise(attempts)]
    assert gaps[:4] == [20.0, 40.0, 60.0, 60.0]
    assert set(gaps[2:]) == {60.0}
    assert len(attempts) > 24 * 60 - 5  # for as long as the run lasts
    at_s = [restart for restart, _ in restarts]
    assert all(at_s[i + 50] - at_s[i] >= 60 for i in range(len(at_s) - 50))
    policy = RestartPolicy()  # who lasts for a whole period is as good as any other again
    restarts_of(policy, 100)
    assert policy.attempts
    policy.restarted(200)
    assert policy.delay_s(259) is None
    assert policy.delay_s(260.1) == 0.0
    assert policy.attempts == 0


@pytest.mark.parametrize("name", ["DM2", "osmosis_control"])
@within(partial(played, SOON))
async def test_a_process_that_fails_at_its_start_is_given_up_and_tried_again(world, name):
    world.machine.sick.add(name)
    world.kill(name)
    await asyncio.sleep(0.02)
    world.respawn(name, 1)  # of RM3's node; once: the module may have been released since
    await eventually(lambda: world.row(name)[0] == "given up", 20)
    await asyncio.sleep(0.01)
    given_up_s, forks = world.clock.now(), len(world.machine.forks)
    assert forks == 8
    asked = len(world.events)
    world.respawn(name, 2)  # whoever asks meanwhile is answered, and gets no process
    await asyncio.sleep(0.05)
    assert (name, "given up", world.row(name)[1]) in world.events[asked:]
    next_s = next(row.next_attempt_s for row in world.supervisor.rows() if row.name == name)
    await asyncio.sleep(next_s - world.clock.now() - 0.01)
    assert len(world.machine.forks) == forks
    await asyncio.sleep(0.03)
    assert len(world.machine.forks) == forks + 1
    await asyncio.sleep(given_up_s + 60 - world.clock.now())
    attempts = len(world.machine.forks) - forks
    assert 13 <= attempts <= 17  # 5 s, 2 s, and then one in four seconds
    assert world.row(name)[0] == "given up"
    world.machine.sick.clear()
    await eventually(lambda: world.row(name)[0] == "running", 10)
    assert len(world.machine.of(name)) == 1
    await asyncio.sleep(10)
    world.kill(name)  # it is like any other again
    await asyncio.sleep(0.02)
    world.respawn(name, world.row(name)[1])
    await eventually(lambda: world.row(name)[0] == "running", 0.2)


SHORT = Supervision()
SLOW = Supervision(intensity=3, period_s=60)
"""Three restarts within a minute are too many; a process is well after ten minutes."""


@pytest.mark.parametrize(("limits", "works", "present_s", "failing"), [
    (SHORT, [0.1] * 3, 0.0, True), (SHORT, [0.1] * 3, 1.1, False), (SHORT, [0.1] * 2, 0.0, False),
    (SHORT, [1.3] * 20, 1.3, True), (SHORT, [1.3] * 20, 10.1, False),
    (SHORT, [2.9] * 9, 0.1, False), (SHORT, [1.3] * 20 + [12.0] + [1.3] * 9, 0.0, False),
    (SHORT, [300.0] + [9.9] * 20, 0.0, True),
    (SLOW, [70.0] * 3, 0.0, True), (SLOW, [70.0] * 2, 0.0, False), (SLOW, [70.0] * 3, 599.0, True),
    (SLOW, [70.0] * 3, 600.0, False), (SLOW, [70.0, 70.0, 601.0, 70.0], 0.0, False),
    (SLOW, [900.0] * 40, 0.0, False)])  # killed four times an hour
def test_a_node_is_failing_whose_last_processes_worked_for_a_short_time_only(
        limits, works, present_s, failing):
    one, now_s = Lives(limits), 0.0
    for worked_s in works:
        one.forked()
        now_s += 9.0  # a cold start of nine seconds counts for nothing
        one.worked(now_s)
        now_s += worked_s
        assert one.ended(now_s)
        assert not one.ended(now_s)
    one.forked()
    one.worked(now_s)
    assert one.failing(now_s + present_s) == failing


def test_a_node_may_have_limits_of_its_own():
    general = Supervision(intensity=50, attempt_s=10.0, attempt_max_s=60.0)
    limits = RestartLimits(intensity=3, at_most_s=5.0).within(general)
    assert (limits.intensity, limits.period_s, limits.backoff_s) == (3, 60.0, 0.05)
    assert (limits.backoff_max_s, limits.attempt_s, limits.attempt_max_s) == (5.0, 5.0, 5.0)
    assert RestartLimits().within(general) == general


@within(partial(played, Supervision(intensity=3, period_s=20.0)))
async def test_an_unstable_node_is_reported_at_each_end_and_restarted_without_a_request(world):
    """No recovery module requests it any more: its own has failed, and a safer one acts."""
    for incarnation in range(1, 4):
        await asyncio.sleep(25.0)
        assert world.failing == set()
        world.kill("osmosis_control")  # of RM3
        await asyncio.sleep(0.02)
        world.respawn("osmosis_control", incarnation)
        await eventually(lambda: world.row("osmosis_control")[0] == "running", 1)
    await asyncio.sleep(25.0)
    assert world.failing == {"osmosis_control"}
    world.kill("osmosis_control")
    await asyncio.sleep(1.0)
    assert world.row("osmosis_control")[:2] == ("running", 5)
    told = [event for node, event, _ in world.events if node == "osmosis_control"]
    assert told.count("unstable") == 2
    await asyncio.sleep(199.0)
    assert world.failing == {"osmosis_control"}
    await asyncio.sleep(2.0)
    assert world.failing == set()
    assert [event for node, event, _ in world.events if node == "osmosis_control"][-1] == "stable"


@pytest.mark.parametrize("ends", ["dies after 1.3 s", "is never heard"])
@within(partial(played, Supervision(intensity=50, backoff_s=0.01, backoff_max_s=0.01)))
async def test_the_table_shows_which_node_is_failing(world, ends):
    until_s = asyncio.get_running_loop().time() + 100.0
    while asyncio.get_running_loop().time() < until_s:
        (process,) = world.machine.of("DM2")
        if ends == "is never heard":
            process.bound = False
        await asyncio.sleep(1.3)
        if ends == "dies after 1.3 s":
            world.machine.kill(process)
        await eventually(lambda before=process: before not in world.machine.of("DM2"), 5)
        await eventually(lambda: world.machine.of("DM2"), 5)
    await asyncio.sleep(0.5)
    assert world.failing == {"DM2"}
    if ends == "dies after 1.3 s":
        await asyncio.sleep(11.0)
        assert world.failing == set()


@within(partial(played, SOON))
async def test_a_node_that_is_adapted_is_not_held_to_what_it_was_given_up_for(world):
    process = world.supervisor._processes["DM2"]
    for _ in range(20):
        process.policy.restarted(asyncio.get_running_loop().time())
    world.kill("DM2")
    await eventually(lambda: world.row("DM2")[0] == "given up")
    document, _ = adapt(load_document(PLAN), Change(
        Action.RETUNE, "DM2", {"timeout_s": 0.995}), PLAN.system_file)
    world.say(topics.ADAPTED_SYSTEM, AdaptedSystem(
        2, "retune DM2", "somebody", msgspec.json.encode(document).decode()))
    await eventually(lambda: world.row("DM2")[0] == "running", 0.3)


@pytest.mark.parametrize(("node", "sick"), [
    ("safety_pilot", SickPilot),
    pytest.param("DM2", SickModule, marks=pytest.mark.nightly),
    pytest.param("ftm_manager", SickManager, marks=pytest.mark.nightly)])
def test_the_robot_stands_until_what_was_given_up_is_back_and_then_goes_on(tmp_path, node, sick):
    usual = sick.__mro__[2]
    soon = "".join(f"{name} = {value}\n" for name, value in msgspec.structs.asdict(SOON).items())
    text = (ROOT / "systems" / "paper.toml").read_text(encoding="utf-8")
    file = tmp_path / "sick.toml"
    file.write_text(text.replace(
        f'"{usual.__module__}:{usual.__name__}"', f'"{__name__}:{sick.__name__}"', 1)
        + f"\n[supervision]\n{soon}", encoding="utf-8")
    result = run_virtually(Job(
        row="x", system=str(file), patience_s=120,
        options={"mission": str(write_short_mission(tmp_path))},
        faults=(parse_fault(f"kill:{node}@15"),)))
    record = result.record
    assert (record.mission, record.safety, record.reasons) == ("success", "safe", ())
    given_up = [e.t_s for e in record.events if f"{node} given up" in e.text]
    assert len(given_up) >= 3
    assert {name for name, _ in result.failures} == {node}
    stands_s = given_up[0] + 3.0  # silence is noticed after 0.99 s, and then it brakes
    assert [at for at in record.track if stands_s < at[0] < SICK_S[1]] == []
