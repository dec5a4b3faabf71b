"""What is given up on is tried again as long as the run lasts, and meanwhile the robot stands."""

from __future__ import annotations

import asyncio
from functools import partial
from itertools import pairwise

import msgspec
import pytest

from rampart.actors.ftm import topics
from rampart.actors.ftm.messages import AdaptedSystem
from rampart.actors.runtime.run_plan import load_document
from rampart.actors.supervision.supervised_process import Lives, RestartPolicy
from rampart.manager.spec.adaptation import Action, Change, adapt
from rampart.manager.spec.nodes import RestartLimits
from rampart.manager.spec.tables import Supervision
from rampart.sim.campaign.job import Job, run_virtually
from rampart.sim.faults.scenario import parse_fault
from rampart.testing import eventually
from tests.actors.supervision.sick_actors import (
    ACTORS,
    SICK_S,
    SOON,
    write_sick_system,
)
from tests.actors.supervision.test_supervisor import PLAN
from tests.actors.supervision.test_supervisor import running as played
from tests.virtual_time import within
from tests.whole.missions import write_short_mission


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


@pytest.mark.parametrize(("works", "present_s", "failing"), [
    ([(3, 0.1)], 0.0, True), ([(3, 0.1)], 1.1, False), ([(2, 0.1)], 0.0, False),
    ([(20, 1.3)], 1.3, True), ([(20, 1.3)], 10.1, False), ([(9, 2.9)], 0.1, False),
    ([(20, 1.3), (1, 12.0), (9, 1.3)], 0.0, False), ([(1, 300.0), (20, 9.9)], 0.0, True)])
def test_a_node_is_failing_whose_last_processes_worked_for_a_short_time_only(
        works, present_s, failing):
    one, now_s = Lives(), 0.0
    for count, worked_s in works:
        for _ in range(count):
            one.forked()
            one.worked(now_s + 9.0)  # a cold start of nine seconds counts for nothing
            now_s += 9.0 + worked_s
            one.ended(now_s)
            one.ended(now_s + 5.0)
    one.forked()
    one.worked(now_s)
    assert one.failing(now_s + present_s) == failing


# Three restarts within a minute are too many; a process is well after ten minutes.
@pytest.mark.parametrize(("works", "present_s", "failing"), [
    ([70.0] * 3, 0.0, True), ([70.0] * 2, 0.0, False), ([70.0] * 3, 599.0, True),
    ([70.0] * 3, 600.0, False), ([70.0, 70.0, 601.0, 70.0], 0.0, False),
    ([70.0, 0.5, 70.0, 0.5, 70.0], 2.0, True),  # short lives between count for intensity only
    ([900.0] * 40, 0.0, False)])  # killed four times an hour
def test_a_node_that_dies_more_slowly_than_its_window_is_failing_until_it_is_well(
        works, present_s, failing):
    one, now_s = Lives(Supervision(intensity=3, period_s=60)), 0.0
    for worked_s in works:
        one.forked()
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


@pytest.mark.parametrize("ends", ["dies after 1.3 s", "is never heard", "well"])
@within(partial(played, Supervision(intensity=50, backoff_s=0.01, backoff_max_s=0.01)))
async def test_the_table_shows_which_node_is_failing(world, ends):
    until_s = asyncio.get_running_loop().time() + 100.0
    while ends != "well" and asyncio.get_running_loop().time() < until_s:
        (process,) = world.machine.of("DM2")
        if ends == "is never heard":
            process.bound = False
        await asyncio.sleep(1.3)
        if ends == "dies after 1.3 s":
            world.machine.kill(process)
        await eventually(lambda before=process: before not in world.machine.of("DM2"), 5)
        await eventually(lambda: world.machine.of("DM2"), 5)
    await asyncio.sleep(0.5)
    assert world.failing == (set() if ends == "well" else {"DM2"})
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


@pytest.mark.parametrize("node", ACTORS)
def test_the_robot_stands_until_what_was_given_up_is_back_and_then_goes_on(tmp_path, node):
    result = run_virtually(Job(
        row="x", system=str(write_sick_system(tmp_path, node)), patience_s=120,
        options={"mission": str(write_short_mission(tmp_path))},
        faults=(parse_fault(f"kill:{node}@15"),)))
    record = result.record
    assert (record.mission, record.safety, record.reasons) == ("success", "safe", ())
    given_up = [e.t_s for e in record.events if f"{node} given up" in e.text]
    assert len(given_up) >= 3
    assert {name for name, _ in result.failures} == {node}
    stands_s = given_up[0] + 3.0  # silence is noticed after 0.99 s, and then it brakes
    assert [at for at in record.track if stands_s < at[0] < SICK_S[1]] == []
