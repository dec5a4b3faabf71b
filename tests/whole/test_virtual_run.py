"""Whole missions in virtual time: the same to the byte, as on processes, each guard alone."""

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import msgspec
import pytest

from rampart.actors.recording.bag_reader import BagReader, Summary
from rampart.cli import run as launch
from rampart.cli.main import main
from rampart.sim.campaign.job import Job, RunResult, run_job, run_virtually
from rampart.sim.faults.scenario import parse_fault
from rampart.sim.osmosis.trial import mission_trial
from rampart.sim.runs.virtual_run import LEAD_S
from rampart.testing import HEEDS_SIGNALS, RealRun
from tests import ROOT, system_file
from tests.actors.recording.samples import pose
from tests.whole.missions import write_mission

OVERLOAD = "slow:all:0.025@20+30"


def job(*faults: str, options=None, **changes) -> Job:
    """A job on the paper's system: what it does under a fault is known, and it is the quicker."""
    return Job(row="test", options={"mission": "A", **(options or {})},
               faults=tuple(map(parse_fault, faults)), **{"system": "paper", **changes})


@pytest.fixture
def near(tmp_path):
    """Options of a job: a mission of half a minute, a sixth of mission A."""
    return {"mission": str(write_mission(tmp_path, "NEAR"))}


def decisions(result):
    return [(d.active, d.recoveries) for d in result.decisions]


def test_a_run_is_the_same_to_the_byte_in_another_process_and_another_with_another_seed(
        tmp_path, capsys):
    def arguments(seed: int) -> list[str]:
        return ["--virtual", "--mission", str(write_mission(tmp_path, "NEAR")), "--seed", str(seed),
                "--fault", "kill:mission_manager@6", "--fault", "wedge:DM2@3", "--fault",
                "gps-noise@1", "--json", "--report", str(tmp_path / "report")]

    def trace_of(printed: str) -> str:
        result = json.loads(printed.splitlines()[-1])
        assert all(fault["effective"] for fault in result["faults"])
        return str(result["trace"])

    def in_this_process(seed: int) -> str:
        assert launch.main(arguments(seed)) == 0
        return trace_of(capsys.readouterr().out)

    done = subprocess.run(
        [sys.executable, "launch.py", *arguments(5)], cwd=ROOT, text=True, capture_output=True,
        env={**os.environ, "PYTHONHASHSEED": "4711"}, check=False)
    trace = in_this_process(5)
    assert trace_of(done.stdout) == trace != in_this_process(6)
    assert len(trace) == 64


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
def test_a_run_that_is_broken_off_has_a_recording_with_all_that_was_sent(
        tmp_path, monkeypatch, error):
    class BrokenOff(launch.VirtualRun):
        def run(self):
            self._taps[0](*pose(1, 0.5))
            raise error

    monkeypatch.setattr(launch, "VirtualRun", BrokenOff)
    path = tmp_path / "run.mcap"
    with contextlib.suppress(RuntimeError):
        assert launch.main(["--virtual", "--record", str(path), "--report", str(tmp_path)]) == 1
    summary = Summary(BagReader(path))
    assert (summary.reader.closed, summary.end["messages"]) == (True, "1")
    assert {"osmosis_control", "supervisor"} <= set(json.loads(summary.run["nodes"]))
    assert summary.time_zero_s == -LEAD_S


def recorded_run(tmp_path) -> subprocess.Popen[str]:
    """Start a run in virtual time and return it once its recording has begun."""
    path = tmp_path / "run.mcap"
    launched = subprocess.Popen(
        [*HEEDS_SIGNALS, sys.executable, "launch.py", "--virtual", "--record", str(path),
         "--report", str(tmp_path / "report"), "--json"], cwd=ROOT, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, text=True)
    while not (path.exists() and path.stat().st_size > 300_000):
        assert launched.poll() is None, launched.communicate()
        time.sleep(0.01)
    return launched


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_a_run_in_order_with_its_report_and_its_recording(tmp_path, number):
    launched = recorded_run(tmp_path)
    launched.send_signal(number)
    out, errors = launched.communicate(timeout=30)
    assert launched.returncode == 1, errors
    result = json.loads(out.splitlines()[-1])
    assert f"ended: interrupted by {number.name}" in result["reasons"]
    assert list((tmp_path / "report").glob("*.html"))
    summary = Summary(BagReader(tmp_path / "run.mcap"))
    assert summary.reader.closed
    assert int(summary.end["messages"]) > 1000


def test_a_second_signal_ends_a_run_at_once_and_what_was_recorded_can_be_read(tmp_path):
    launched = recorded_run(tmp_path)
    for number in (signal.SIGSTOP, signal.SIGINT, signal.SIGTERM, signal.SIGCONT):
        launched.send_signal(number)  # so that both are there when it goes on
    out, errors = launched.communicate(timeout=30)
    assert (launched.returncode, out) == (1, "")
    assert "Traceback" not in errors
    assert not list(tmp_path.glob("report/*.html"))
    # Wherever it hit, in the middle of a write perhaps.
    assert sum(1 for _ in BagReader(tmp_path / "run.mcap").messages()) > 1000


@pytest.mark.parametrize("fault", ["drop:detection/DM1@10+inf", "slow:DM1@10"])
def test_a_detection_module_that_lives_and_is_not_heard_costs_nothing(near, fault):
    result = run_job(job(fault, options=near))
    assert (result.success, result.safe, result.decisions) == (True, True, ())
    assert (result.false_alarms, result.failures) == (0, ())
    assert result.effective


def test_a_frozen_report_hides_no_fault():
    result = run_job(job("freeze:detection/DM2@10+inf", "command-not-updated@14+inf",
                         patience_s=15.0))
    assert result.safe
    assert (("FTM2",), ("RM2",)) in decisions(result)


@pytest.mark.parametrize(("fault", "soonest_s", "latest_s"), [
    ("kill:osmosis_control@10", 0.0, 0.1), ("stop:graph_planner@12", 0.3, 0.6),
    ("wedge:osmosis_control@12", 0.3, 0.6)])
def test_a_process_that_is_killed_or_silent_is_detected_and_replaced_and_the_mission_goes_on(
        near, fault, soonest_s, latest_s):
    result = run_job(job(fault, options=near))
    assert (result.success, result.safe) == (True, True)
    assert decisions(result) == [(("FTM4",), ("RM3",)), ((), ())]
    assert soonest_s < result.detected_after_s < latest_s
    assert result.detected_after_s < result.recovered_after_s < result.detected_after_s + 0.4


def test_a_machine_that_is_overloaded_is_one_fault_and_the_mission_goes_on_afterwards(tmp_path):
    # Long enough to blame a single node.
    mission = {"mission": str(write_mission(tmp_path, "SHORT"))}
    record = run_virtually(job(OVERLOAD, system="osmosis", options=mission)).record
    assert (record.mission, record.safety, record.restarts) == ("success", "safe", {})
    assert [(d.active, d.recoveries) for d in record.decisions] == [
        (("FTM14",), ("RM2",)), ((), ())]


@pytest.mark.parametrize(("faults", "restarts"), [
    (["drop:detection/DM2@10+8"], {"DM2": 1}), (["stop:all@10+30"], {}),  # everybody pauses
    (["stop:all@10+5", "kill:localization@12", "wedge:graph_planner@15.1"],
     {"localization": 1, "graph_planner": 1})])
def test_only_what_is_not_heard_or_dies_is_restarted_pauses_of_everybody_or_not(
        near, faults, restarts):
    record = run_virtually(job(*faults, system="osmosis", options=near)).record
    assert (record.mission, record.safety, record.restarts) == ("success", "safe", restarts)
    assert not [d for d in record.decisions if "RM1" in d.recoveries]


@pytest.mark.slow
def test_an_overload_in_which_nearly_nothing_arrives_leaves_no_latch_behind():
    record = run_virtually(job("slow:all:0.2@20+30", system="osmosis")).record
    assert (record.mission, record.safety) == ("success", "safe")
    assert ("FTM1", "RM1") in {(f, rm) for d in record.decisions
                               for f in d.active for rm in d.recoveries}
    assert record.decisions[-1].active == ()


def test_killed_detection_modules_know_the_state_again_before_their_silence_counts(near):
    kills = [f"kill:DM{n}@{1.5 * n}" for n in range(1, 15)]
    result = run_job(job(*kills, system="osmosis", options=near))
    assert (result.success, result.safe, decisions(result)) == (True, True, [])


def test_a_manager_that_hangs_after_each_start_stops_the_robot_until_it_works(near):
    lost = run_job(job("hang:ftm_manager@12+inf", options=near, patience_s=8.0))
    assert (lost.success, lost.safe, lost.stopped_for_good) == (False, True, True)
    record = run_virtually(job("hang:ftm_manager@12+6", options=near)).record
    assert (record.mission, record.safety) == ("success", "safe")
    assert record.restarts["ftm_manager"] > 4


def test_a_supervisor_that_ends_too_often_waits_until_the_window_of_the_spec_has_room(tmp_path):
    file = tmp_path / "impatient.toml"
    file.write_text((ROOT / "systems" / "paper.toml").read_text(encoding="utf-8")
                    + "\n[supervision]\nintensity = 2\nperiod_s = 10.0\nbackoff_s = 0.5\n",
                    encoding="utf-8")
    kills = [f"kill:supervisor@{at_s}" for at_s in (4, 6, 8)]
    record = run_virtually(job(*kills, "kill:mission_manager@20", system=str(file))).record
    back_s = [e.t_s for e in record.events if "supervisor respawned" in e.text]
    assert len(back_s) == 3
    assert back_s[0] < 4.5  # at once
    assert 6.5 < back_s[1] < 7.0  # after the backoff
    assert 14.5 < back_s[2] < 15.0  # ten seconds after the first restart, and the backoff


def test_a_fault_without_effect_says_so_and_one_may_be_planned_for_a_goal(near):
    result = run_job(job("imu-bias@2", "kill:DM1@900", "kill:mission_manager@goal2:1",
                         options=near))
    assert [o.effective for o in result.outcomes] == [False, False, True]
    assert [o.reason for o in result.outcomes] == [
        "it changed nothing", "its moment never came", ""]
    assert not result.success
    assert result.duration_s > 8


@pytest.mark.processes
@pytest.mark.alone
@pytest.mark.timeout(180)
def test_virtual_and_real_runs_take_the_same_decisions_and_come_to_the_same_verdict(tmp_path):
    faults = ("kill:osmosis_control@3", "command-out-of-bounds@5+1", "wedge:graph_planner@8.5",
              "localization-not-updated@11+2", "kill:localization@15.5", "stop:hmi@17.5+2",
              "kill:mission_manager@20")
    virtual = run_job(job(*faults))
    arguments = [x for fault in faults for x in ("--fault", fault)]
    with RealRun(tmp_path, "paper", "--mission", "A", "--rate", "1", *arguments) as run:
        code, real = run.result(120)
    assert code == 1
    assert (real["mission"], real["safety"]) == ("fail", "safe")
    assert (virtual.success, virtual.safe) == (False, True)
    assert all(fault["effective"] for fault in real["faults"]), real["faults"]
    assert all(o.effective for o in virtual.outcomes), virtual.outcomes
    seen = [(tuple(d["active"]), tuple(d["recoveries"])) for d in real["decisions"]]
    assert seen == decisions(virtual), run.story
    for one, other in zip(real["decisions"], virtual.decisions, strict=True):
        assert one["t_s"] == pytest.approx(other.t_s, abs=0.35)


# Every unsafe run that was ever found, and shrunk, is run again, on the system that it was found on
# and on the full one. Those of the paper's system run in the night: the full system's laser checks
# have tests of their own.
FOUND = {file.stem: msgspec.toml.decode(file.read_bytes(), type=Job)
         for file in sorted((Path(__file__).parent / "counterexamples").glob("*.toml"))}


assert FOUND


@pytest.mark.parametrize(("name", "system"), [
    pytest.param(name, system, marks=[pytest.mark.nightly] * (job.system != "osmosis"))
    for name, job in FOUND.items() for system in sorted({job.system, "osmosis"})])
def test_what_was_unsafe_once_is_safe_now(name, system):
    result = run_job(msgspec.structs.replace(FOUND[name], system=system))
    assert result.effective, [outcome.reason for outcome in result.outcomes]
    assert result.safe, result.reasons
    assert result.failures == ()


SYSTEM = ROOT / "systems/osmosis-ros2.toml"
"""Its driver speaks ROS 2."""


def test_a_mission_in_virtual_time_survives_the_gateway(tmp_path, capsys):
    assert main(["run", "--system", str(SYSTEM), "--virtual", "--json", "--report", str(tmp_path),
                 "--mission", str(write_mission(tmp_path, "NEAR")), "--fault", "kill:gateway@6",
                 "--fault", "kill:osmosis_control@9"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert (result["mission"], result["safety"]) == ("success", "safe")
    assert all(fault["effective"] for fault in result["faults"])


LAYERS = ("dead_man", "safety_pilot_checks", "manager_watch", "supervisor_respawn", "ftm",
          "checkpoints")
STALE = "command-not-updated@14+inf"
"""The robot drives on with its last command: straight off the pavement, unless somebody acts."""

NO_STANDBY = "kill:standby_control@13"
"""In the full system a stale command is masked by the standby, unless that is gone too."""


@pytest.fixture
def layered(tmp_path, monkeypatch):
    """Return a maker of runs of mission A on a system in which only the layers named are on.

    A run ends soon after the robot has come to stand, and an unguarded robot that drives away is
    not watched for a whole minute.
    """
    monkeypatch.setattr(mission_trial, "WATCH_S", 2.0)

    def made(system: str, layers: tuple[str, ...], *faults: str) -> Job:
        text = system_file(system).read_text(encoding="utf-8")
        for layer in LAYERS:
            text, found = re.subn(rf"(?m)^{layer} = (true|false)",
                                  f"{layer} = {str(layer in layers).lower()}", text)
            assert found == 1, layer
        file = tmp_path / f"{system}-{'-'.join(layers)}.toml"
        file.write_text(text, encoding="utf-8")
        return Job(row="x", system=str(file), options={"mission": "A"}, patience_s=8.0,
                   faults=tuple(map(parse_fault, faults)))

    return made


def both(made, system: str, layers: tuple[str, ...], without: tuple[str, ...], *faults: str
         ) -> tuple[RunResult, RunResult]:
    """Run with and without a layer."""
    guarded = run_job(made(system, layers, *faults))
    bare = run_job(made(system, without, *faults))
    for result in (guarded, bare):
        assert all(o.effective for o in result.outcomes), result.outcomes
        assert result.failures == ()
    return guarded, bare


@pytest.mark.parametrize(("system", "fault"), [
    ("paper", "kill:safety_pilot@14"),
    ("osmosis", "wedge:safety_pilot@14"),
])
def test_the_dead_man_alone_stops_a_robot_whose_safety_pilot_is_gone(layered, system, fault):
    guarded, bare = both(layered, system, ("dead_man",), (), fault)
    assert (guarded.safe, guarded.success) == (True, False)
    assert guarded.margins["prohibited_m"] > 0.9  # it stands on the centre line, where it was
    assert not bare.safe


@pytest.mark.parametrize(("system", "faults"), [
    ("paper", ("command-out-of-bounds@14+inf",)), ("osmosis", (STALE, NO_STANDBY))])
def test_the_safety_pilots_checks_alone_stop_a_robot_that_is_commanded_wrongly(
        layered, system, faults):
    guarded, bare = both(layered, system, ("safety_pilot_checks",), (), *faults)
    assert (guarded.safe, guarded.success, guarded.decisions) == (True, False, ())
    assert guarded.margins["prohibited_m"] > 0.9
    assert not bare.safe


END = "kill:mission_manager@20"
"""The mission is lost, and so the run is over soon."""


def test_the_obstacle_stop_needs_no_other_layer(layered):
    result = run_job(layered("paper", (), "obstacle-ahead:2@14", END))
    assert [o.effective for o in result.outcomes] == [True, True]
    assert result.safe
    assert 0 < result.margins["obstacle_m"] < 1


def test_the_safety_pilots_check_of_the_laser_alone_keeps_a_blind_robot_from_driving(layered):
    faults = ("laser-stuck@14+inf", "obstacle-ahead:4@14.1", END)
    guarded, bare = both(layered, "paper", ("safety_pilot_checks",), (), *faults)
    assert (guarded.safe, bare.safe) == (True, False)


def test_the_watch_on_the_manager_alone_stops_a_robot_that_nobody_looks_after(layered):
    guarded, bare = both(layered, "osmosis", ("ftm", "manager_watch"), ("ftm",),
                         "kill:ftm_manager@12", NO_STANDBY, STALE)
    assert (guarded.safe, guarded.success) == (True, False)
    assert not bare.safe


def test_the_manager_alone_stops_what_the_layers_below_would_let_pass(layered):
    guarded, bare = both(layered, "paper", ("ftm",), (), STALE)
    assert (guarded.safe, guarded.success) == (True, False)
    assert [(d.active, d.recoveries) for d in guarded.decisions] == [(("FTM2",), ("RM2",))]
    assert 0.9 < guarded.detected_after_s < 1.1
    assert not bare.safe


@pytest.mark.parametrize(("module", "recovery"), [("DM1", "RM1"), ("DM6", "RM5")])
def test_the_manager_takes_a_dead_detection_module_for_an_active_one(layered, module, recovery):
    result = run_job(layered("paper", ("ftm",), f"kill:{module}@14"))
    assert (result.safe, result.success) == (True, False)
    assert result.decisions[0].recoveries == (recovery,)


def test_the_supervisor_alone_brings_a_safety_pilot_back_before_anything_happens(layered):
    faults = ("kill:safety_pilot@14", END)
    guarded = run_virtually(layered("osmosis", ("supervisor_respawn",), *faults)).record
    bare = run_virtually(layered("osmosis", (), *faults)).record
    assert (guarded.safety, guarded.restarts) == ("safe", {"safety_pilot": 1})
    assert (bare.safety, bare.restarts) == ("unsafe", {})


def test_what_brings_the_supervisor_back_needs_nobody_else(layered):
    faults = ("kill:supervisor@4", "wedge:supervisor@6", "kill:mission_manager@10")
    record = run_virtually(layered("paper", (), *faults)).record
    assert (record.safety, record.restarts) == ("safe", {"supervisor": 2})


def test_all_guards_killed_at_once_are_back_before_anything_happens(layered):
    dead = ("supervisor", "ftm_manager", "safety_pilot")
    record = run_virtually(layered("paper", LAYERS[:-1], *(f"kill:{name}@14" for name in dead),
                               "command-out-of-bounds@16+inf")).record
    assert record.safety == "safe"
    assert record.restarts == dict.fromkeys(dead, 1)
    assert [d.recoveries for d in record.decisions] == [("RM2",)]  # they work again
