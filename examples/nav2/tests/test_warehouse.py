"""Rounds in virtual time, each with something going wrong, and one on processes."""

import asyncio
import json
from pathlib import Path

import numpy as np
import pytest

from rampart.testing import RealRun, VirtualSystem, free_port, run, virtual_run

SYSTEM = Path(__file__).resolve().parents[1] / "warehouse.toml"


@pytest.fixture
def changed(tmp_path, monkeypatch):
    """Return a function that writes the system with one text replaced, and returns the file."""
    monkeypatch.syspath_prepend(SYSTEM.parent)

    def write(old, new):
        text = SYSTEM.read_text(encoding="utf-8")
        assert old in text
        file = tmp_path / "warehouse.toml"
        file.write_text(text.replace(old, new, 1))
        return file

    return write


def at_night(*case):
    return pytest.param(*case, marks=pytest.mark.nightly)


LONG = ("localization-jump@12", "battery-low@10")
"""The robot stands, or drives slowly, for so long that only a whole round has their end."""


# At night also those of which another one in each suite is answered by the same mechanism.
@pytest.mark.parametrize("whole", [False, at_night(True)])
@pytest.mark.parametrize(("fault", "mechanism", "recovery"), [
    at_night("localization-jump@12", "M_JUMP", "R_STOP"),
    ("costmap-stale@10", "M_COSTMAP", "R_RESTART"),
    ("drop:nav/command@10+5", "M_SILENT", "R_RESTART"),
    at_night("control-late@10", "M_REPORTED", "R_RESTART"),
    ("no-way@10", "M_REPORTED", "R_RESTART"),
    at_night("goal-aborted@10", "M_REPORTED", "R_RESTART"),
    ("stuck:guard/velocity@10+inf", "M_GUARD_STUCK", "R_RESTART"),
    ("drop:guard/velocity@10+inf", "M_GUARD_SILENT", "R_RESTART"),
    ("corrupt:guard/velocity@10+inf", "M_TURN", "R_RESTART"),
    ("drop:nav/scan@10+inf", "M_BLIND", "R_RESTART"),
    at_night("delay:nav/odometry@10+inf", "M_BLIND", "R_RESTART"),
    ("zero:nav/command@10+inf", "M_STANDS", "R_RESTART"),
    ("battery-low@10", "M_BATTERY", "R_SLOW"),
    at_night("kill:controller_server@10", "M_CRASH", "R_RESTART"),
    at_night("kill:amcl@10", "M_CRASH", "R_RESTART"),
    ("wedge:planner_server@10", "M_CRASH", "R_RESTART")])
def test_the_mechanism_against_a_fault_acts_and_lets_go_and_the_round_is_made(
        fault, mechanism, recovery, whole):
    is_whole = whole or fault in LONG
    done = virtual_run(SYSTEM, fault) if is_whole else virtual_run(
        SYSTEM, fault.replace("@10", "@5"), seconds=13.0)
    assert (done.judgement.safe, done.failures) == (True, ())
    # A node of ROS 2 that is killed is missed twice, in the same millisecond.
    assert any(mechanism in decision.active for decision in done.record.decisions)
    assert recovery in done.record.decisions[0].recoveries
    assert done.judgement.success or not is_whole
    assert is_whole or done.record.decisions[-1].active == ()


def test_without_a_fault_the_round_is_made_without_a_decision():
    done = virtual_run(SYSTEM)
    assert (done.judgement.safe, done.judgement.success) == (True, True)
    assert (done.failures, done.record.decisions) == ((), ())


def test_a_command_that_is_stuck_ends_before_the_next_obstacle_and_the_round_is_made():
    done = virtual_run(SYSTEM, "stuck:nav/command@28.24+inf")
    assert (done.judgement.safe, done.judgement.success) == (True, True)
    assert any("M_STANDS" in decision.active for decision in done.record.decisions)


@pytest.mark.parametrize(("topic", "wrong", "mechanism"), [
    ("nav/command", "{ linear_mps = 0.8, angular_radps = 0.3 }", None),
    ("guard/velocity", "{ linear_mps = -0.5 }", "M_SPEED")])
def test_a_velocity_that_is_wrong_within_its_bounds_leads_into_no_obstacle(
        topic, wrong, mechanism, changed):
    """Nothing compares `nav/command` with what was sent, but the guard looks where it drives."""
    fault = (f'[[fault]]\nname = "wrong"\ntitle = "Wrong"\ntopic = "{topic}"\nmode = "corrupt"\n'
             f"duration_s = 1000.0\nset = {wrong}\n")
    done = virtual_run(changed("[[fault]]\n", f"{fault}[[fault]]\n"), "wrong@10", seconds=40.0)
    assert done.judgement.safe is True
    active = {name for decision in done.record.decisions for name in decision.active}
    assert mechanism is None or mechanism in active


@pytest.mark.parametrize("fault", [
    "hang:planner_server@10", pytest.param("control-late@10+inf", marks=pytest.mark.nightly)])
def test_after_an_error_that_outlasts_each_restart_the_round_is_made_slowly(fault):
    done = virtual_run(SYSTEM, fault)
    assert (done.judgement.safe, done.judgement.success) == (True, True)
    commanded = {name for decision in done.record.decisions for name in decision.recoveries}
    assert commanded == {"R_RESTART", "R_SLOW"}


def test_a_detection_module_that_hangs_for_good_stops_nothing_and_its_twin_detects():
    done = virtual_run(SYSTEM, "hang:D_JUMP@5", "localization-jump@12")
    assert (done.judgement.safe, done.judgement.success) == (True, True)
    first = done.record.decisions[0]
    assert (first.active, first.recoveries) == (("M_JUMP",), ("R_STOP",))
    assert 12.0 < first.t_s < 13.5


def test_the_robot_drives_on_after_a_long_jump_of_the_localization():
    """A robot that a recovery has stopped does not stand for nothing."""
    done = virtual_run(SYSTEM, "localization-jump@20+11")
    assert (done.judgement.safe, done.judgement.success) == (True, True)


def test_what_stands_between_may_die_and_nobody_notices():
    done = virtual_run(SYSTEM, "kill:gateway@10", "kill:guard@20")
    assert (done.judgement.safe, done.judgement.success) == (True, True)
    assert done.record.restarts == {"gateway": 1, "guard": 1}


def test_with_an_empty_battery_the_goal_is_cancelled_and_the_robot_stands_still(changed):
    head = 'name = "base"\n'
    done = virtual_run(changed(head, head + "parameters = { charge = 0.03 }\n"), seconds=30.0)
    assert done.judgement.safe is True
    assert done.record.decisions[-1].recoveries == ("R_CANCEL",)


def test_a_node_that_ends_again_and_again_is_unstable_and_the_robot_drives_slowly(
        changed):
    """Each of its processes works for a while, so the crash itself is over at once each time."""
    head = 'name = "controller_server"\n'
    done = virtual_run(changed(head, head + "restart = { intensity = 2, period_s = 5.0 }\n"),
                       "kill:controller_server@11.5", "kill:controller_server@23", seconds=30.0)
    assert done.judgement.safe is True
    assert done.record.restarts == {"controller_server": 2}
    assert any("R_SLOW" in decision.recoveries for decision in done.record.decisions)


def test_what_was_commanded_during_a_stop_is_not_executed_at_its_end(monkeypatch):
    """Neither if it is late, nor if the guard was restarted meanwhile."""
    monkeypatch.syspath_prepend(SYSTEM.parent)
    from warehouse import topics

    async def scenario():
        async with VirtualSystem.load(SYSTEM) as system:
            guard = system.start_node("guard")
            command, scan = map(guard.chosen_topic, ("nav/command", "nav/scan"))
            checked = system.hear(topics.CHECKED)

            async def commanded(before_s=0.0):
                system.say(scan, scan.type(
                    angle_min_rad=0.0, angle_increment_rad=0.1, range_min_m=0.0, range_max_m=6.0,
                    ranges_f32=np.full(60, 5.0, np.float32).tobytes(), nearest_m=5.0))
                await asyncio.sleep(0.02)
                system.say(command, command.type(
                    linear_mps=0.5, lateral_mps=0.0, angular_radps=0.0),
                    stamp_s=system.clock.now() - before_s)
                await asyncio.sleep(0.02)
                return checked[-1].message.linear_mps

            assert await commanded() == 0.5
            system.say(topics.ORDER, topics.Order(True), "R_STOP")
            assert await commanded() == 0.0
            system.say(topics.ORDER, topics.Order(False), "R_STOP")
            assert await commanded(before_s=0.1) == 0.0
            assert await commanded() == 0.5
            system.say(topics.ORDER, topics.Order(True), "R_STOP")
            await system.kill("guard")
            system.start_node("guard")
            assert await commanded() == 0.0

    run(scenario)


def test_without_the_mechanisms_a_jump_of_the_localization_does_harm():
    assert virtual_run(SYSTEM, "localization-jump@3+inf", seconds=60.0, ftm=False,
                       ).judgement.success is False


@pytest.mark.slow
@pytest.mark.processes
def test_on_processes_it_drives_over_the_wire_format_and_a_killed_controller_is_back(
        tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(SYSTEM.parent))
    port = free_port()
    text = SYSTEM.read_text(encoding="utf-8")
    here = [f"tcp/127.0.0.1:{port}"]
    for node in ("controller_server", "planner_server", "amcl", "base"):
        head = f'name = "{node}"\n'
        text = text.replace(head, f"{head}parameters = {{ connect = {json.dumps(here)} }}\n", 1)
    text = text.replace('name = "ros_router"\n', 'name = "ros_router"\n'
                        f'parameters = {{ listen = "{here[0]}" }}\n')
    text = text.replace('parameters = { distribution = "jazzy" }',
                        f"parameters = {{ connect = {json.dumps(here)} }}")
    (tmp_path / "warehouse.toml").write_text(text)
    with RealRun(tmp_path, tmp_path / "warehouse.toml", "--duration", "8", "--rate", "1") as run:
        run.sleep_until(4.0)
        run.kill("controller_server")
        code, result = run.result(60)
    assert result["safety"] == "safe", run.story
    assert result["restarts"] == {"controller_server": 1}
    assert "(R_RESTART)" in run.story
    assert code in {0, 1}
