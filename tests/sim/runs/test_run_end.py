"""When a run is over, as timelines, and how one that was cut off is found to be resumed."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from dataclasses import replace as with_system
from pathlib import Path

import msgspec
import pytest
from msgspec.structs import replace

from rampart import systems
from rampart.actors.ftm import topics
from rampart.actors.ftm.messages import NodeInfo, NodeState, NodeTable
from rampart.actors.osmosis import messages as m
from rampart.actors.runtime.actor import Header
from rampart.actors.runtime.clock import Clock
from rampart.actors.runtime.run_context import RunContext
from rampart.actors.runtime.run_plan import RunPlan, load_system
from rampart.actors.system.layout import load_run
from rampart.sim.osmosis.trial import mission_trial as trial
from rampart.sim.osmosis.trial.mission_trial import WATCH_S, RunEnd
from rampart.sim.runs import resumption
from rampart.sim.runs.process_run import _RELINK_S, excused_s
from rampart.sim.runs.trial import Trial, trial_class

STANDS = m.Twist(0.0, 0.0)
GOALS = (m.Goal(1.0, 2.0, m.Mode.TAXI), m.Goal(3.0, 4.0, m.Mode.TAXI))


def mission(phase: m.MissionPhase = m.MissionPhase.RUNNING, step: int = 0, mission_id: str = "m1",
            reason: str = "") -> m.MissionStatus:
    return m.MissionStatus(mission_id, "A", phase, step, GOALS, (), (), reason)


LOST = mission(m.MissionPhase.IDLE, mission_id="")


def going(distance_m: float) -> m.ControlStatus:
    return m.ControlStatus("m1", 0, m.ControlPhase.FOLLOWING, 0, distance_m)


def test_a_robot_is_watched_after_its_mission_until_it_stands_or_for_a_minute():
    for twist in (m.Twist(0.3, 0.0), m.Twist(0.0, -0.5)):
        end = RunEnd(60.0)
        end.mission(mission(), 1.0)
        end.mission(mission(m.MissionPhase.SUCCEEDED, 2), 9.0)
        assert end.ended(9.0 + trial.SETTLE_S - 0.1) is None
        assert end.ended(9.0 + trial.SETTLE_S) == "mission succeeded"
        end.truth(twist, 20.0)
        assert end.ended(20.0) is None
        end.truth(STANDS, 21.0)
        assert end.ended(21.0) == "mission succeeded"
        end.truth(twist, 9.0 + WATCH_S)
        assert end.ended(9.0 + WATCH_S) == "mission succeeded"


def test_so_is_one_whose_mission_is_lost_was_never_taken_or_does_not_advance():
    lost, stuck, idle = (RunEnd(10.0) for _ in range(3))
    for end in (lost, stuck):
        end.mission(mission(), 1.0)
    lost.mission(LOST, 2.0)
    for end, since_s, why in ((lost, 2.0, "mission lost"), (stuck, 11.0, "no progress"),
                              (idle, trial.ACCEPT_WITHIN_S, "no mission was accepted")):
        for now_s in (since_s + 5.0, since_s + WATCH_S - 0.1):
            end.truth(m.Twist(0.3, 0.0), now_s)
            assert end.ended(now_s) is None
        end.truth(STANDS, since_s + WATCH_S - 0.05)
        assert (end.ended(since_s + WATCH_S - 0.05) or "").startswith(why)
        end.truth(m.Twist(0.3, 0.0), since_s + WATCH_S)
        assert (end.ended(since_s + WATCH_S) or "").startswith(why)


def test_a_mission_manager_that_forgot_its_mission_ends_the_run_and_a_flicker_does_not():
    end = RunEnd(60.0)
    end.mission(mission(), 1.0)
    end.mission(LOST, 5.0)
    end.mission(mission(), 6.0)
    assert end.ended(5.0 + trial.LOST_AFTER_S + 0.1) is None
    end.mission(LOST, 10.0)
    assert "mission lost" in (end.ended(10.0 + trial.LOST_AFTER_S + 0.1) or "")


def test_patience_counts_from_the_last_progress_and_driving_in_circles_is_none():
    end = RunEnd(10.0)
    end.mission(mission(), 0.0)
    end.control(going(20.0), 1.0)
    end.control(going(19.0), 5.0)
    for t_s in range(6, 15):
        end.control(going(19.0 + t_s % 2), float(t_s))
    assert end.ended(14.9) is None
    assert end.ended(15.1) == "no progress for 10 s"
    end.mission(mission(step=1), 15.1)
    assert end.ended(25.0) is None


def test_a_mission_that_a_recovery_holds_to_the_end_says_which():
    end = RunEnd(10.0)
    end.mission(mission(), 0.0)
    end.mission(mission(m.MissionPhase.PAUSED, reason="held by RM1: DM1: lost"), 3.0)
    assert end.ended(10.1) == "no progress for 10 s: mission paused, held by RM1: DM1: lost"


def test_a_mission_of_the_operator_is_waited_for_and_one_that_nobody_takes_or_a_lost_world_is_not():
    end = RunEnd(10.0, waits=True)
    assert end.ended(10_000.0) is None
    end.mission(mission(), 10_000.0)
    assert end.ended(10_009.9) is None
    assert end.ended(10_010.1) == "no progress for 10 s"
    assert RunEnd(100.0).ended(trial.ACCEPT_WITHIN_S) is None
    assert "no mission was accepted" in (RunEnd(100.0).ended(trial.ACCEPT_WITHIN_S + 0.1) or "")
    late = RunEnd(60.0, begins_s=500.0)  # a part of a resumed run
    assert late.ended(529.0) is None
    assert "no mission was accepted" in str(late.ended(532.0))
    end.truth(STANDS, 10_012.0)
    assert end.world_gone(10_012.0 + trial.WORLD_LATE_S) == ""
    assert "the world is gone" in end.world_gone(10_012.1 + trial.WORLD_LATE_S)


def test_a_way_round_something_is_progress_once_and_the_longer_way_is_measured_anew():
    end = RunEnd(10.0)
    end.mission(mission(), 0.0)
    end.control(going(20.0), 1.0)
    end.mission(mission(reason="way round (3, 4)"), 9.0)
    end.control(going(60.0), 9.1)
    end.control(going(50.0), 17.0)
    end.mission(mission(reason="way round (3, 4)"), 26.0)
    assert end.ended(26.9) is None
    assert end.ended(27.1) == "no progress for 10 s"
    for number in range(100):
        end.mission(mission(reason=f"way round ({number}, 4)"), 30.0 + number)
    assert end.ended(60.0) == "no progress for 10 s", "to and fro is no progress"


def test_who_has_no_route_yet_or_has_arrived_does_not_say_how_near_it_came():
    end = RunEnd(patience_s=40.0)
    end.mission(mission(), 0.0)
    for phase in (m.ControlPhase.IDLE, m.ControlPhase.WAITING, m.ControlPhase.ARRIVED):
        end.control(m.ControlStatus("m1", 0, phase, 0, 0.0), 0.1)
    end.control(going(30.0), 1.0)
    end.control(going(20.0), 35.0)
    assert end.ended(60.0) is None
    assert end.ended(76.0) == "no progress for 40 s"


# -- What a launcher that was stopped excuses, without a process; the rest is in tests/whole --


@pytest.mark.parametrize("late_s", [-0.01, 0.0, 0.4])
def test_a_loaded_machine_excuses_nothing(late_s):
    assert excused_s(late_s) == 0.0


@pytest.mark.parametrize("rate", [0.5, 1.0, 4.0])
def test_a_launcher_that_was_stopped_dials_its_partners_again_before_the_world_counts_as_gone(rate):
    end = RunEnd(patience_s=60.0, waits=True)
    end.truth(m.Twist(0.0, 0.0), 10.0)
    awake_s = 10.0 + 7.0 * rate  # stopped for seven seconds of wall time
    end.excuse(excused_s(7.0) * rate)
    relinked_s = awake_s + _RELINK_S * rate
    assert end.world_gone(relinked_s) == ""
    assert "the world is gone" in end.world_gone(relinked_s + trial.WORLD_LATE_S + 0.1)


# -- Which node tables end a judged run because its world is dead, as timelines --


STATES = {"s": NodeState.STARTING, "R": NodeState.RUNNING, "x": NodeState.CRASHED,
          "T": NodeState.STOPPED}


@pytest.fixture(scope="module")
def run() -> RunContext:
    plan = RunPlan(system_file=str(systems.find("paper")), options={"mission": "A"})
    return load_run(plan, load_system(plan))


def ended(trial: Trial, states: str) -> bool:
    """Whether tables at intervals of half a second with these states of the world end a run."""
    for number, state in enumerate(states):
        header = Header("supervisor", 1, number + 1, number / 2)
        table = NodeTable(tuple(NodeInfo(name, "world", 7, STATES[of], 1, 0)
                                for name, of in (("controller", "x"), ("simulator", state))))
        for sink in trial.sinks(Clock(0.0)):
            sink(topics.NODES, table, header)
    return "the world has died" in (trial.ended(len(states) / 2) or "")


@pytest.mark.parametrize(("states", "ends"), [
    ("xxxxsR", False),  # before its first process
    ("sRRxx", True), ("sxx", True),
    ("sRRxRxR", False),  # a new supervisor has not adopted it yet
    ("sRTTTTR", False)])
def test_a_world_that_stays_dead_ends_the_run(run, states, ends):
    assert ended(trial_class(run.system)(run), states) is ends


def test_without_a_judge_or_with_a_recovery_module_that_restarts_it_the_run_goes_on(run):
    assert not ended(Trial(run), "sRRxx")
    nodes = tuple(replace(node, respawn="RM3") if node.name == "simulator" else node
                  for node in run.system.nodes)
    restarted = with_system(run, system=replace(run.system, nodes=nodes))
    assert not ended(trial_class(run.system)(restarted), "sRRxx")


# -- What a run keeps so that it can be resumed: found again, or refused in one line --


@pytest.fixture
def system(tmp_path) -> Path:
    file = tmp_path / "system.toml"
    file.write_text("name = 'x'")
    return file


def begun(reports: Path, name: str, system: Path, **changes) -> resumption.RunFiles:
    """Keep what a run keeps when it starts, and let go of it as if it had been killed."""
    directory = reports / name
    directory.mkdir(parents=True)
    files = resumption.RunFiles(directory)
    plan = RunPlan(run_id=f"id-{name}", system_file=str(system), options={"mission": "AB"})
    kept = resumption.manifest_of(plan, ["--rate", "2"], [])
    files.save(msgspec.structs.replace(kept, **changes))
    return files


@pytest.mark.parametrize("which", ["", "reports/b", "b", "id-b"])
def test_a_run_is_found_by_directory_name_and_id_or_as_the_newest_that_did_not_end(
        tmp_path, system, monkeypatch, which):
    monkeypatch.chdir(tmp_path)
    for number, (name, ended) in enumerate((("a", ""), ("b", ""), ("c", "success, safe"))):
        files = begun(tmp_path / "reports", name, system, ended=ended)
        os.utime(files.directory / resumption.MANIFEST, (1000 + number, 1000 + number))
    files, manifest = resumption.find(Path("reports"), which)
    assert (manifest.run_id, manifest.arguments) == ("id-b", ("--rate", "2"))
    files.unlock()


def damaged(text: str):
    return lambda files: (files.directory / resumption.MANIFEST).write_text(text)


def kept(**changes):
    return lambda files: files.save(msgspec.structs.replace(files.manifest(), **changes))


@pytest.mark.parametrize(("change", "which", "why"), [
    (lambda files: (files.directory / resumption.MANIFEST).unlink(), "a", resumption.MANIFEST),
    (damaged("{"), "", resumption.MANIFEST), (damaged('{"format": 1, "run_id": 7}'), "a", "run_id"),
    (kept(format=99), "a", "99"), (kept(ended="fail, safe"), "a", "has ended (fail, safe)"),
    (kept(ended="fail, safe"), "", "no run that did not end"),
    (lambda _files: None, "b", "no such run")])
def test_a_run_that_cannot_be_resumed_is_refused_in_one_line(tmp_path, system, change, which, why):
    change(begun(tmp_path / "reports", "a", system))
    with pytest.raises(resumption.ResumptionError) as refused:
        resumption.find(tmp_path / "reports", which)
    assert why in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_run_that_lives_is_not_resumed_and_one_that_is_just_ending_is_waited_for(
        tmp_path, system, monkeypatch):
    """Any process of the run keeps the lock, for it was forked with it."""
    files = begun(tmp_path / "reports", "a", system)
    assert files.lock()
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"],
                             pass_fds=[files._lock])
    files.unlock()
    monkeypatch.setattr(resumption, "_PATIENCE_S", 0.2)
    with pytest.raises(resumption.ResumptionError, match="still lives"):
        resumption.find(tmp_path / "reports", "a")
    child.kill()
    child.wait()
    assert files.lock()
    monkeypatch.setattr(time, "sleep", lambda _s: files.unlock())
    found, _ = resumption.find(tmp_path / "reports", "a")
    found.unlock()


def manifest(system: Path, **changes) -> resumption.Manifest:
    plan = RunPlan(run_id="r", system_file=str(system), options={"mission": "AB"})
    return resumption.manifest_of(msgspec.structs.replace(plan, **changes), [], [])


def test_another_system_seed_or_mission_is_named_and_another_rate_is_none_of_these(system):
    before = manifest(system)
    assert resumption.differences(before, manifest(system, rate=4.0, run_id="s")) == ""
    assert "seed is 2, expected 1" in resumption.differences(before, manifest(system, seed=2))
    assert "mission is 'A', expected 'AB'" in resumption.differences(
        before, manifest(system, options={"mission": "A"}))
    assert "ftm" in resumption.differences(before, manifest(system, ftm=False))
    system.write_text("name = 'y'")
    assert f"{system} has changed" in resumption.differences(before, manifest(system))


def test_the_newest_memory_is_recalled_unless_it_is_damaged_until_the_run_has_ended(
        tmp_path, system):
    files, recalled = resumption.RunFiles(tmp_path), list[bytes]()

    def recall(memory: bytes) -> float:
        if memory == b"\xc1":
            raise msgspec.ValidationError("Expected `object`")
        recalled.append(memory)
        return 7.0

    assert files.recall("r", recall) == (0.0, "")
    for memory in (b"first", b"second"):
        files.keep_memory("r", memory)
    assert files.recall("r", recall) == (7.0, "")
    assert recalled == [b"second"]
    (kept,) = tmp_path.glob("record-*")
    kept.write_bytes(kept.read_bytes()[:-1])
    assert "its checksum is wrong" in files.recall("r", recall)[1]
    files.keep_memory("r", b"\xc1")  # whole, but not a record of this run
    assert "Expected `object`" in files.recall("r", recall)[1]
    files.end(manifest(system))
    assert files.recall("r", recall) == (0.0, "")
    assert files.manifest() == manifest(system)


def test_a_run_that_did_not_start_leaves_the_one_before_it_as_it_was(tmp_path, system):
    files = begun(tmp_path, "a", system)
    for before in (files.manifest(), None):
        saved = files.saved()
        files.save(manifest(system))
        files.put_back(saved)
        if before is None:
            assert not (files.directory / resumption.MANIFEST).exists()
        else:
            assert files.manifest() == before
            (files.directory / resumption.MANIFEST).unlink()
