"""Nodes that hold data come back with it: same mission, same step, each light exactly once."""

from __future__ import annotations

import random
from pathlib import Path
from typing import Any

import msgspec
import pytest

from rampart.actors.bus import messages as bm
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis.control.following.light_ledger import LightsKept
from rampart.actors.osmosis.control.following.light_row import LightRow
from rampart.actors.osmosis.control.following.path_follower import PathFollower
from rampart.actors.osmosis.control.following.route_control import CONTROL_STATE, ControlKept
from rampart.actors.osmosis.control.mission.mission_state import (
    MISSION_STATE,
    MissionState,
    catch_up,
)
from rampart.actors.osmosis.control.polyline import NO_POINTS
from rampart.actors.runtime.checkpoint import Loaded, MemoryCheckpoints, StateError
from rampart.actors.runtime.run_plan import RunPlan, load_system
from rampart.actors.system.layout import load_run
from rampart.manager.arbitration.arbiter import build_arbiter
from rampart.manager.arbitration.arbiter_memory import Latch, Memory, objection, recall, remember
from rampart.manager.arbitration.arbiter_state import Command
from rampart.manager.spec.specification import parse_specification
from rampart.sim.faults.scenario import parse_fault
from rampart.sim.osmosis.trial.mission_trial import MissionTrial
from rampart.sim.runs.virtual_run import VirtualRun
from rampart.sim.virtual.virtual_processes import VirtualMachine
from tests import ROOT
from tests.actors.osmosis.control.world import Circle, World, drive
from tests.whole.missions import SHORT_LIGHTS, write_mission

P = m.MissionPhase
GOALS = tuple(m.Goal(float(i), 0.0, m.Mode.TAXI) for i in range(4))
PAPER = (ROOT / "systems" / "paper.toml").read_text()
SPEC = parse_specification(PAPER, "paper.toml")
CONTROL = ("mission_manager", "graph_planner", "osmosis_control")
OK = m.LightMeasurement("A", 1.0, 1.0, m.LightVerdict.OK)


def mission(step: int = 1, phase: m.MissionPhase = P.RUNNING, **changes) -> MissionState:
    times = changes.pop("step_times_s", (5.0,) * step)
    return MissionState("x", "X", phase, GOALS, step, 10.0, times, **changes)


# -- states of nodes -----------------------------------------------------------------------------


@pytest.mark.parametrize(("state", "heard", "step", "times"), [
    (mission(1), 2, 2, (5.0, 20.0)),  # the newest checkpoint was lost
    (mission(0), 3, 3, (20.0, 0.0, 0.0)),
    (mission(2), 2, 2, (5.0, 5.0)),
    (mission(2), 1, 2, (5.0, 5.0)),  # control has not heard of the new goal yet
    (mission(2), 4, 2, (5.0, 5.0)),  # the number of goals: on the way home
    (mission(2), 99, 2, (5.0, 5.0)),
    (mission(1, P.CANCELLED), 3, 1, (5.0,)),
    (mission(1, P.PAUSED), 2, 2, (5.0, 20.0)),
])
def test_a_mission_catches_up_with_the_step_that_others_were_given(state, heard, step, times):
    after = catch_up(state, heard, 30.0)
    assert (after.step, after.step_times_s, after.phase) == (step, times, state.phase)
    assert MISSION_STATE.objection(after) == ""


@pytest.mark.parametrize("state", [
    mission(9), mission(-1, step_times_s=()), mission(4), mission(2, step_times_s=(1.0,)),
    msgspec.structs.replace(mission(), mission_id=""), mission(lights=(OK, OK)),
    msgspec.structs.replace(mission(), goals=(m.Goal(float("nan"), 0.0, m.Mode.TAXI),) * 4),
    ControlKept(LightsKept("x", (OK, OK))), ControlKept(progress_m=float("nan")),
    ControlKept(row_start=(0.0, float("inf"))),
    ControlKept(LightsKept("x"), m.Route("y", 0, m.Mode.TAXI, True, (), "")),
])
def test_a_state_that_makes_no_sense_is_refused(state):
    form, sound = ((MISSION_STATE, mission()) if isinstance(state, MissionState)
                   else (CONTROL_STATE, ControlKept()))
    with pytest.raises(StateError):
        form.decode(1, form.encode(state))
    assert form.decode(1, form.encode(sound)) == sound


# -- rows, again ---------------------------------------------------------------------------------


def test_a_way_back_that_is_blocked_is_given_up():
    world, row = World(x_m=10.0), LightRow(((0.0, 0.0), (14.0, 0.0)))
    world.circles.append(Circle(7.0, 0.0, 0.4))
    row.step(10.0, 0.0, 0.0, NO_POINTS, 0.05)
    row.go_back(3.0)
    motion = drive(world, row, 60.0)
    assert motion.arrived
    assert world.least_clearance_m > 0.5


@pytest.mark.parametrize("kind", [PathFollower, LightRow])
def test_a_follower_that_resumes_stays_on_its_leg_where_the_route_comes_near_itself(kind):
    there_and_back = ((0.0, 0.0), (20.0, 0.0), (20.0, 1.0), (0.0, 1.0))
    place = (10.0, 0.6)  # nearer to the way back
    resumed, anew = kind(there_and_back, near_s_m=9.5), kind(there_and_back)
    astray = kind(there_and_back, near_s_m=20.5)  # the robot was moved meanwhile
    for follower in (resumed, anew):
        follower.step(*place, 0.0, NO_POINTS, 0.05)
    astray.step(2.0, 0.0, 0.0, NO_POINTS, 0.05)
    assert resumed.progress_m == pytest.approx(10.0)
    assert anew.progress_m == pytest.approx(31.0)
    assert astray.progress_m == pytest.approx(2.0)


# -- the arbiter's memory ------------------------------------------------------------------------


def test_decisions_are_numbered_on_and_flapping_is_not_forgotten():
    arbiter = build_arbiter(SPEC)
    memory = Memory(20, (), (("DM6", 2.5, 7.0),))
    back = recall(arbiter, memory, 8.0, 10)
    assert [(t.name, t.bucket_s) for t in back.detections if t.bucket_s] == [("DM6", 2.5)]
    assert remember(back, arbiter) == memory
    assert recall(arbiter, memory, 8.0, 70_000).number == 70_000


def test_a_memory_that_makes_no_sense_is_refused_and_modules_of_the_past_are_left_out():
    for memory, why in (
            (Memory(-1), "decision number -1"), (Memory(2**60), "decision number 1152921504"),
            (Memory(1, (), (("DM1", float("nan"), 0.0),)), "bucket of DM1")):
        assert objection(memory).startswith(why)
    assert objection(Memory(1)) == ""
    assert objection(Memory(1, (Latch(Command("RM2", False, 1), ()),))) == ""  # beneath a safer one
    arbiter = build_arbiter(SPEC)
    memory = Memory(5, (Latch(Command("RM9", True, 5), ()),), (("DM9", 1.0, 1.0),))
    assert recall(arbiter, memory, 1.0, 0) == arbiter.initial(1.0, 5)


# -- whole missions in virtual time --------------------------------------------------------------


def with_checkpoints(folder: Path) -> Path:
    """Write the paper's system with checkpoints."""
    assert PAPER.count("checkpoints = false") == 1
    file = folder / "kept.toml"
    file.write_text(PAPER.replace("checkpoints = false", "checkpoints = true"))
    return file


class Flight(MissionTrial):
    """A mission of the paper's system with checkpoints, and what is said in it, by kind."""

    @classmethod
    def fly(cls, mission: Path, *faults: str, seed: int = 1, patience_s: float = 60.0) -> Flight:
        plan = RunPlan(seed=seed, system_file=str(with_checkpoints(mission.parent)),
                       options={"mission": str(mission)})
        flight = cls(load_run(plan, load_system(plan)), patience_s)
        flight.heard: dict[type, list[Any]] = {}
        flight.result = VirtualRun(flight, scenario=tuple(map(parse_fault, faults))).run()
        return flight

    def sinks(self, clock):
        def take(_topic, message, _header):
            self.heard.setdefault(type(message), []).append(message)

        return [*super().sinks(clock), take]

    def told(self, words: str) -> list[str]:
        """Return the nodes that reported something with these words."""
        return sorted(d.node for d in self.heard.get(bm.Diagnostic, ()) if words in d.reason)

    def assert_nothing_lost_or_doubled(self) -> None:
        """Safe success, no step twice or left out, each light measured once and rightly."""
        record = self.result.record
        assert (record.mission, record.safety, record.reasons) == ("success", "safe", ())
        assert self.result.failures == ()
        said = [status for status in self.heard[m.MissionStatus] if status.mission_id]
        steps = [status.step for status in said]
        assert steps == sorted(steps), "the mission went back a step"
        assert len(said[-1].step_times_s) == len(said[-1].goals)
        assert sorted(light.light for light in said[-1].lights) == sorted(SHORT_LIGHTS)
        assert {light.light: light.verdict for light in said[-1].lights} == SHORT_LIGHTS
        # A measurement may be sent again; another one of the same light would be another value.
        assert len({(light.light, light.intensity_cd)
                    for light in self.heard[m.LightMeasurement]}) == len(SHORT_LIGHTS)


@pytest.fixture
def short(tmp_path) -> Path:
    return write_mission(tmp_path, "SHORT")


@pytest.mark.parametrize("seed", [
    0, *(pytest.param(seed, marks=pytest.mark.nightly) for seed in range(1, 40))])
def test_control_nodes_die_at_random_moments_and_nothing_is_lost_or_doubled(short, seed):
    dice = random.Random(seed)
    faults = [f"{dice.choice(('kill', 'kill', 'stop', 'wedge'))}:{node}@{dice.uniform(1, 54):.3f}"
              for node in CONTROL]
    Flight.fly(short, *faults, seed=seed).assert_nothing_lost_or_doubled()


@pytest.mark.parametrize("faults", [
    [f"kill:{node}@{t}" for t in (20.0, 43.0) for node in CONTROL],  # all at once
    ["kill:mission_manager@goal1:0.0", "kill:graph_planner@goal1:0.0",  # in the very step
     "kill:mission_manager@goal2:0.0", "kill:osmosis_control@goal2:0.0"]])
def test_deaths_at_once_and_from_one_goal_to_the_next_skip_and_repeat_no_step(short, faults):
    flight = Flight.fly(short, *faults)
    flight.assert_nothing_lost_or_doubled()
    assert sum(flight.result.record.restarts.values()) == len(faults)


def test_a_light_whose_pass_was_cut_is_gone_back_for(short):
    flight = Flight.fly(short, "stop:osmosis_control@42")
    flight.assert_nothing_lost_or_doubled()
    assert flight.told("passed without a measurement, going back")
    assert flight.result.record.duration_s > 62  # 57 s without


def newest_corrupt(loaded: Loaded) -> Loaded:
    first, *others = loaded.records
    torn = first._replace(state=first.state[:-3])
    return Loaded((torn, *others), loaded.problems)


@pytest.fixture
def tampering(monkeypatch):
    """Change what the second and later lives of a node load: `tampering(node, change)`."""
    load, changes = MemoryCheckpoints.load, {}
    store = VirtualMachine._store

    def naming(self, name, incarnation):
        made = store(self, name, incarnation)
        made.name = name
        return made

    def tampered(self) -> Loaded:
        loaded, change = load(self), changes.get(getattr(self, "name", ""))
        return change(loaded) if change and self._incarnation > 1 else loaded

    monkeypatch.setattr(VirtualMachine, "_store", naming)
    monkeypatch.setattr(MemoryCheckpoints, "load", tampered)
    return changes.__setitem__


def test_a_newest_checkpoint_that_is_torn_gives_way_to_the_one_before(short, tampering):
    for node in CONTROL:
        tampering(node, newest_corrupt)
    # Just after the step: the one before is of the goal that is reached.
    flight = Flight.fly(short, "kill:mission_manager@goal2:0.02", "kill:graph_planner@goal1:0.1",
                        "kill:osmosis_control@45", "kill:mission_manager@47")
    flight.assert_nothing_lost_or_doubled()
    assert flight.told("taking the newest sound one") == [
        "graph_planner", "mission_manager", "mission_manager", "osmosis_control"]


@pytest.mark.parametrize("change", [
    lambda _: Loaded(),
    lambda loaded: Loaded(tuple(r._replace(version=99) for r in loaded.records)),
    lambda loaded: Loaded(tuple(r._replace(state=b"\xc1") for r in loaded.records)),
], ids=["missing", "another version", "senseless"])
def test_without_any_sound_checkpoint_the_mission_ends_safely_and_says_so(
        short, tampering, change):
    tampering("mission_manager", change)
    flight = Flight.fly(short, "kill:mission_manager@12")
    record = flight.result.record
    assert (record.mission, record.safety) == ("fail", "safe")
    assert record.restarts == {"mission_manager": 1}, "a crash loop"
    assert flight.told("starting without a checkpoint")


def test_planner_and_control_go_on_without_any_checkpoint(short, tampering):
    for node in ("graph_planner", "osmosis_control"):
        tampering(node, lambda _: Loaded())
    Flight.fly(short, "kill:graph_planner@20", "kill:osmosis_control@25", "kill:osmosis_control@45",
               "kill:graph_planner@46").assert_nothing_lost_or_doubled()


def test_an_emergency_stop_outlives_recovery_module_and_manager(short):
    record = Flight.fly(short, "gps-dropout@3+3", "kill:RM1@8", "kill:ftm_manager@8",
                        patience_s=10.0).result.record
    assert (record.mission, record.safety) == ("fail", "safe")
    assert record.restarts == {"RM1": 1, "ftm_manager": 1}
    assert record.decisions[-1].recoveries == ("RM1",)
