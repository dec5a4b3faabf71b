"""The world: time, obstacles, collisions, the prohibited area; and one that blows up or dies."""

from __future__ import annotations

import math

import msgspec
import pytest
import shapely

from rampart.actors.osmosis.airport.model import Airport, ObstaclePreset, StartPose, rectangle
from rampart.actors.runtime.checkpoint import StateError
from rampart.sim.osmosis.scene import SPARE_OBSTACLES, WorldError
from rampart.sim.osmosis.world import WORLD_STATE, Clearance, World
from rampart.testing import virtual_run
from tests.sim.osmosis import bench

# A road 40 m long and 4 m wide, eastward; the robot starts in its west.
ROAD = shapely.box(-2, -2, 38, 2)


def road(**changes) -> Airport:
    return Airport("Road", {"a": (0.0, 0.0), "b": (30.0, 0.0)}, (("a", "b"),), ROAD,
                   StartPose(0, 0, 0), **changes)  # fmt: skip


def world(airport: Airport | None = None, **changes) -> World:
    return bench.world(airport or road(), **changes)




# ---- prohibited area ----------------------------------------------------------------


def test_time_in_the_prohibited_area_counts_from_the_first_corner_over_the_edge():
    sim = world(road())
    sim.command(1.0, 0.0)
    while sim.pose[0] < 37.5:  # the front edge is 0.36 m ahead: at 37.64 it leaves the road
        sim.step_to(sim.time_s + 0.1)
        assert sim.truth().prohibited_s == 0.0
    entered_s = sim.time_s + (37.64 - sim.pose[0]) / 1.0
    sim.step_to(sim.time_s + 3.0)
    assert sim.truth().prohibited_s == pytest.approx(sim.time_s - entered_s, abs=0.1)
    assert sim.truth().prohibited_clearance_m < -1.0


# ---- collisions ---------------------------------------------------------------------


def test_a_contact_is_one_collision_however_long_it_lasts_and_another_hit_a_second():
    sim = world()
    sim.add_obstacle("drum", 3.0, 0.0, 0.4)
    sim.command(1.0, 0.0)
    sim.step_to(2.0)
    assert sim.truth().collisions == 0
    sim.step_to(8.0)
    assert sim.truth().collisions == 1
    assert sim.pose[0] < 3.0 - 0.4 - 0.36 + 0.03
    assert sim.truth().obstacle_clearance_m < 0.02
    for linear in (-0.5, 0.8):
        sim.command(linear, 0.0)
        sim.step_to(sim.time_s + 4.0)
    assert sim.truth().collisions == 2
    after = world(start_s=20.0, kept=sim.keep())
    after.step_to(20.1)
    assert after.truth().collisions >= 2, "a resumed run goes on counting"


# ---- obstacles ----------------------------------------------------------------------

PRESETS = (
    ObstaclePreset("drum", "cylinder", 20.0, 0.0, 0.4),
    ObstaclePreset("worker", "box", 8.0, 0.0, 0.3, appears_within_m=5.0, gone_after_s=4.0),
    ObstaclePreset("late", "cylinder", 30.0, 0.0, 0.3, present_from_s=2.0),
)


def names(sim: World) -> set[str]:
    return {solid.name for solid in sim.obstacles}


def test_the_first_presets_take_part_and_more_than_there_are_is_refused():
    assert names(world(road(obstacles=PRESETS), obstacles=1)) == {"drum"}
    assert names(world(road(obstacles=PRESETS))) == set()
    with pytest.raises(WorldError, match="obstacles: 4: expected 0 to 3 on Road"):
        world(road(obstacles=PRESETS), obstacles=4)


def test_a_preset_appears_when_the_robot_comes_near_and_goes_after_its_time():
    sim = world(road(obstacles=PRESETS), obstacles=2)
    sim.command(1.0, 0.0)
    while sim.pose[0] < 2.9:
        sim.step_to(sim.time_s + 0.05)
        assert names(sim) == {"drum"}
    sim.command(0.0, 0.0)
    sim.step_to(sim.time_s + 0.3)
    assert names(sim) == {"drum", "worker"}
    came_s = sim.time_s
    while "worker" in names(sim):
        sim.step_to(sim.time_s + 0.05)
    assert sim.time_s - came_s == pytest.approx(4.0, abs=0.4)
    sim.step_to(sim.time_s + 10)
    assert names(sim) == {"drum"}  # it does not come back


def test_a_removed_preset_does_not_come_by_itself_but_can_be_put_back():
    sim = world(road(obstacles=PRESETS), obstacles=3)
    assert sim.remove_obstacle("drum")
    assert not sim.remove_obstacle("late")
    sim.step_to(3.0)
    assert names(sim) == set()
    sim.add_obstacle("drum", 10.0, 1.0, 0.2)
    assert names(sim) == {"drum"}


def test_an_impossible_obstacle_is_refused_and_places_for_others_are_given_back():
    sim = world()
    for place, expected in (
            ((0.5, 0.0, 0.3), "on the robot"), ((math.nan, 0.0, 0.3), "must be finite"),
            ((2e6, 0.0, 0.3), "must be within"), ((5.0, 0.0, 50.0), "radius_m: 50: must be in")):
        with pytest.raises(WorldError, match=expected):
            sim.add_obstacle("x", *place)
    assert names(sim) == set()
    for i in range(SPARE_OBSTACLES):
        sim.add_obstacle(f"o{i}", 5.0 + 2 * i, 0.0, 0.3)
    with pytest.raises(WorldError, match="expected at most"):
        sim.add_obstacle("one more", 3.0, 0.0, 0.3)
    sim.remove_obstacle("o0")
    sim.add_obstacle("one more", 3.0, 0.0, 0.3)
    assert "one more" in names(sim)


# ---- clearance ----------------------------------------------------------------------


def test_a_clearance_is_exact_when_small_and_else_a_lower_bound_with_few_exact_looks():
    wall = shapely.box(10, -50, 11, 50)
    looks = []

    def exact(pose):
        looks.append(pose)
        return wall.distance(rectangle(*pose, 0.72, 0.614))

    clearance = Clearance(exact)
    for step in range(960):
        pose = (0.01 * step, 0.0, 0.002 * step)
        truly = wall.distance(rectangle(*pose, 0.72, 0.614))
        found = clearance.measure(pose)
        if truly < 1.0:
            assert found == pytest.approx(truly)
        else:
            assert found <= truly + 1e-9
    assert len(looks) < 250


# ---- a run that is resumed ------------------------------------------------------------


def test_a_world_goes_on_as_it_was_left():
    presets = (ObstaclePreset("early", "cylinder", 20.0, 0.0, 0.4), ObstaclePreset(
        "timed", "cylinder", 30.0, 1.0, 0.4, present_from_s=2.0, gone_after_s=10.0))
    before = world(road(obstacles=presets), obstacles=2)
    before.add_obstacle("placed", 10.0, 1.5, 0.3)
    before.command(1.0, 0.0)
    before.step_to(3.0)
    kept = WORLD_STATE.decode(1, WORLD_STATE.encode(before.keep()))
    after = world(road(obstacles=presets), obstacles=2, start_s=9.0, kept=kept)
    assert after.pose == pytest.approx(before.pose)
    assert {o.name for o in after.obstacles} == {"early", "timed", "placed"}
    after.step_to(10.0)
    assert after.pose[0] == pytest.approx(before.pose[0], abs=0.02)  # it stands
    after.step_to(12.5)
    assert {o.name for o in after.obstacles} == {"early", "placed"}
    assert (after.truth().collisions, after.truth().prohibited_s) == (0, 0.0)


def test_what_makes_no_sense_is_refused():
    kept = msgspec.structs.replace(world().keep(), pose=(math.nan, 0.0, 0.0))
    with pytest.raises(StateError, match="not finite"):
        WORLD_STATE.decode(1, WORLD_STATE.encode(kept))
    with pytest.raises(WorldError, match="time must be finite"):
        world().step_to(math.nan)


# ---- a world that blows up, or dies: no judge has watched it to its end --------------------------

HARMED_S = 3.0


def blow_up(sim: World) -> None:
    if not sim.data.warning.number.any():
        sim.data.qvel[0] = 1e12


def die(_sim: World) -> None:
    raise RuntimeError("died")


@pytest.mark.parametrize(("harm", "within_s", "reason"), [
    (blow_up, 0.5, "physics unstable"), (die, 1.0, "the world has died")])
def test_a_run_whose_world_blows_up_or_dies_ends_at_once_and_is_neither_safe_nor_a_success(
        monkeypatch, harm, within_s, reason):
    tick = World._tick

    def harmed(self):
        if self.time_s >= HARMED_S:
            harm(self)
        tick(self)

    monkeypatch.setattr(World, "_tick", harmed)
    done = virtual_run("paper", options={"mission": "A"})
    assert (done.record.mission, done.record.safety) == ("fail", "not known")
    assert (done.judgement.success, done.judgement.safe) == (False, None)
    assert done.record.duration_s < HARMED_S + within_s
    assert done.record.reasons[0].startswith(reason)
