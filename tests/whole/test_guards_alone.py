"""Each layer of guards alone: the layers above it are off, and it stops the robot, or mends it.

Where a layer can be switched off there is the contrast: without it as well, the same fault is
unsafe. So what is shown is the layer's doing and not the fault's harmlessness. Whole missions in
virtual time, on the paper's system and on the full one.
"""

import re

import pytest

from rampart.sim.campaign.job import Job, RunResult, run_job, run_virtually
from rampart.sim.faults.scenario import parse_fault
from rampart.sim.osmosis.trial import mission_trial
from tests import system_file

LAYERS = ("dead_man", "safety_pilot_checks", "manager_watch", "supervisor_respawn", "ftm",
          "checkpoints")
STALE = "command-not-updated@14+inf"
"""The robot drives on with its last command: straight off the pavement, unless somebody acts."""

NO_STANDBY = "kill:standby_control@13"
"""In the full system a stale command is masked by the standby, unless that is gone too."""


@pytest.fixture
def job(tmp_path, monkeypatch):
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
def test_the_dead_man_alone_stops_a_robot_whose_safety_pilot_is_gone(job, system, fault):
    guarded, bare = both(job, system, ("dead_man",), (), fault)
    assert (guarded.safe, guarded.success) == (True, False)
    assert guarded.margins["prohibited_m"] > 0.9  # it stands on the centre line, where it was
    assert not bare.safe


@pytest.mark.parametrize(("system", "faults"), [
    ("paper", ("command-out-of-bounds@14+inf",)), ("osmosis", (STALE, NO_STANDBY))])
def test_the_safety_pilots_checks_alone_stop_a_robot_that_is_commanded_wrongly(
        job, system, faults):
    guarded, bare = both(job, system, ("safety_pilot_checks",), (), *faults)
    assert (guarded.safe, guarded.success, guarded.decisions) == (True, False, ())
    assert guarded.margins["prohibited_m"] > 0.9
    assert not bare.safe


END = "kill:mission_manager@20"
"""The mission is lost, and so the run is over soon."""


def test_the_obstacle_stop_needs_no_other_layer(job):
    result = run_job(job("paper", (), "obstacle-ahead:2@14", END))
    assert [o.effective for o in result.outcomes] == [True, True]
    assert result.safe
    assert 0 < result.margins["obstacle_m"] < 1


def test_the_safety_pilots_check_of_the_laser_alone_keeps_a_blind_robot_from_driving(job):
    faults = ("laser-stuck@14+inf", "obstacle-ahead:4@14.1", END)
    guarded, bare = both(job, "paper", ("safety_pilot_checks",), (), *faults)
    assert (guarded.safe, bare.safe) == (True, False)


def test_the_watch_on_the_manager_alone_stops_a_robot_that_nobody_looks_after(job):
    guarded, bare = both(job, "osmosis", ("ftm", "manager_watch"), ("ftm",),
                         "kill:ftm_manager@12", NO_STANDBY, STALE)
    assert (guarded.safe, guarded.success) == (True, False)
    assert not bare.safe


def test_the_manager_alone_stops_what_the_layers_below_would_let_pass(job):
    guarded, bare = both(job, "paper", ("ftm",), (), STALE)
    assert (guarded.safe, guarded.success) == (True, False)
    assert [(d.active, d.recoveries) for d in guarded.decisions] == [(("FTM2",), ("RM2",))]
    assert 0.9 < guarded.detected_after_s < 1.1
    assert not bare.safe


@pytest.mark.parametrize(("module", "recovery"), [("DM1", "RM1"), ("DM6", "RM5")])
def test_the_manager_takes_a_dead_detection_module_for_an_active_one(job, module, recovery):
    result = run_job(job("paper", ("ftm",), f"kill:{module}@14"))
    assert (result.safe, result.success) == (True, False)
    assert result.decisions[0].recoveries == (recovery,)


def test_the_supervisor_alone_brings_a_safety_pilot_back_before_anything_happens(job):
    faults = ("kill:safety_pilot@14", END)
    guarded = run_virtually(job("osmosis", ("supervisor_respawn",), *faults)).record
    bare = run_virtually(job("osmosis", (), *faults)).record
    assert (guarded.safety, guarded.restarts) == ("safe", {"safety_pilot": 1})
    assert (bare.safety, bare.restarts) == ("unsafe", {})


def test_what_brings_the_supervisor_back_needs_nobody_else(job):
    faults = ("kill:supervisor@4", "wedge:supervisor@6", "kill:mission_manager@10")
    record = run_virtually(job("paper", (), *faults)).record
    assert (record.safety, record.restarts) == ("safe", {"supervisor": 2})


def test_all_guards_killed_at_once_are_back_before_anything_happens(job):
    dead = ("supervisor", "ftm_manager", "safety_pilot")
    record = run_virtually(job("paper", LAYERS[:-1], *(f"kill:{name}@14" for name in dead),
                               "command-out-of-bounds@16+inf")).record
    assert record.safety == "safe"
    assert record.restarts == dict.fromkeys(dead, 1)
    assert [d.recoveries for d in record.decisions] == [("RM2",)]  # they work again
