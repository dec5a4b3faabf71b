"""A row of lights: how it is driven, which light is measured, and what is gone back for."""

from __future__ import annotations

import math
import random

import numpy as np
import pytest

from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis.airport.model import Light
from rampart.actors.osmosis.airport.photometry import illuminance_per_candela, sensor_position
from rampart.actors.osmosis.control.following.light_ledger import LightInspection, LightLedger
from rampart.actors.osmosis.control.following.light_row import LightRow, RowLimits
from rampart.actors.osmosis.control.polyline import NO_POINTS, Polyline
from tests.actors.osmosis.control.world import DT_S, Circle, World, drive

WAY = ((0.0, 0.0), (30.0, 0.0))


def light_row(count=6, spacing_m=3.0):
    return [Light(f"L{i}", "L", 2.0 + spacing_m * i, 0.0, 200.0) for i in range(count)]


def inspect(lights, factors, *, seed=0, pose_delay_s=0.0, blind=(), inspection=None):
    """Drive along the lights; `blind` is an interval of x in which the sensor is silent."""
    rng = np.random.default_rng(seed)
    row = LightRow(((0.0, 0.0), (lights[-1].x_m, 0.0)))
    inspection = inspection or LightInspection(lights)
    world = World(y_m=float(rng.uniform(-0.2, 0.2)))
    found = []
    for tick in range(4000):
        now = tick * DT_S
        motion = row.step(world.x_m, world.y_m, world.yaw_rad, world.scan(), DT_S)
        world.move(motion.linear_mps, motion.angular_radps)
        jitter = rng.normal(0.0, 0.01, 2)
        inspection.pose(now + pose_delay_s, world.x_m + jitter[0], world.y_m + jitter[1],
                        world.yaw_rad)
        if not (blind and blind[0] < world.x_m < blind[1]):
            sensor = sensor_position(world.x_m, world.y_m, world.yaw_rad)
            lux = sum(factors[li.name] * li.nominal_cd * illuminance_per_candela(
                math.dist(sensor, (li.x_m, li.y_m))) for li in lights)
            inspection.sample(now, lux * (1 + rng.normal(0, 0.03)) + rng.normal(0, 5.0))
        found += inspection.take(ended=motion.arrived)
        if motion.arrived:
            return found
    raise AssertionError("the row's end was not reached")


def test_the_robot_waits_for_an_obstacle_and_resumes_a_moment_after_it_is_gone():
    world = World(circles=[Circle(10.0, 0.0, 0.4)])
    row = LightRow(WAY, edge_m=lambda _x, _y: 9.0)
    waiting = drive(world, row, 20)
    assert waiting.waiting
    assert world.linear_mps == 0.0
    assert world.clearance() == pytest.approx(1.0, abs=0.1)
    assert world.deviation(list(WAY)) < 0.05, "it never leaves the row"
    world.circles.clear()
    assert drive(world, row, 0.9).linear_mps == 0.0, "free for less than a second"
    assert drive(world, row, 0.5).linear_mps > 0.0
    assert drive(world, row, 60).arrived


def passing_row(half_width_m):
    return LightRow(WAY, limits=RowLimits(pass_after_s=5.0),
                    edge_m=lambda _x, y: half_width_m - abs(y))


@pytest.mark.parametrize("aside_m", [-0.4, 0.0])
def test_an_obstacle_that_stays_is_passed_after_a_wait_and_the_row_is_taken_up_behind_it(aside_m):
    world = World(circles=[Circle(12.0, aside_m, 0.4)])
    motion = drive(world, passing_row(2.75), 70.0)
    assert motion.arrived
    assert world.least_clearance_m >= 0.2
    assert max(abs(y) for _, y in world.track) <= 1.45
    behind = [abs(y) for x, y in world.track if x > 16.0]
    assert behind
    assert max(behind) <= 0.25, "on the row again soon"


@pytest.mark.parametrize(("half_width_m", "aside_m"), [(1.3, (0.0,)), (2.75, (-2, -1, 0, 1, 2))],
                         ids=["no room on the pavement", "both sides are blocked"])
def test_else_it_waits_and_touches_nothing(half_width_m, aside_m):
    world = World(circles=[Circle(12.0, y_m, 0.4) for y_m in aside_m])
    motion = drive(world, passing_row(half_width_m), 30.0)
    assert not motion.arrived
    assert motion.linear_mps == 0.0
    assert world.least_clearance_m >= 0.2
    if len(aside_m) == 1:
        assert max(abs(y) for _, y in world.track) < 0.05


def test_a_standby_goes_back_where_the_active_one_does_and_stops_when_it_does():
    row = LightRow(((0.0, 0.0), (40.0, 0.0)), limits=RowLimits(pass_after_s=5.0),
                   edge_m=lambda _x, _y: 9.0)
    row.step(20.0, 0.0, 0.0, NO_POINTS, DT_S)
    for at_m in (15.0, 15.1):
        row.adopt((at_m, 0.0), passing=False)
        assert row.back_to == pytest.approx((15.0, 0.0))
    row.adopt(None, passing=False)
    assert row.back_to is None


@pytest.mark.parametrize(("spacing_m", "pose_delay_s"), [(1.5, 0.12), (4.0, 0.0)])
def test_each_broken_light_is_found_and_no_good_one_accused(spacing_m, pose_delay_s):
    lights = light_row(8, spacing_m)
    factors = dict(zip((li.name for li in lights),
                       (1.0, 0.0, 0.8, 0.35, 0.6, 0.42, 1.0, 0.0), strict=True))
    found = inspect(lights, factors, pose_delay_s=pose_delay_s)
    assert sorted(m.light for m in found) == [li.name for li in lights], "each exactly once"
    for one in found:
        factor = factors[one.light]
        assert one.verdict == ("out" if factor < 0.05 else "dim" if factor < 0.5 else "ok")
        assert one.ratio == pytest.approx(factor, abs=0.06)
        assert one.intensity_cd == pytest.approx(one.ratio * 200.0)


def test_a_light_whose_samples_are_missing_is_not_judged_until_passed_again():
    lights = light_row(4)
    factors = dict.fromkeys((li.name for li in lights), 1.0)
    inspection = LightInspection(lights)
    first = inspect(lights, factors, blind=(4.3, 4.7), inspection=inspection)
    assert sorted(m.light for m in first) == ["L0", "L2", "L3"]
    again = LightInspection(lights, judged=(m.light for m in first))
    second = inspect(lights, factors, inspection=again)
    assert [(m.light, m.verdict) for m in second] == [("L1", "ok")]


def test_with_a_frozen_pose_nothing_is_judged():
    lights = light_row(3)
    inspection = LightInspection(lights)
    inspection.pose(0.0, 1.5, 0.0, 0.0)
    for tick in range(200):
        inspection.sample(tick * DT_S, 0.0)
        inspection.pose(0.0, 1.5, 0.0, 0.0)
        assert inspection.take() == []
    assert inspection.take(ended=True) == []


# ---- who knows of a measurement, and what is gone back for ---------------------------------------

LIGHTS = tuple(Light(f"L{i}", "L", 4.0 * i, 0.0, 100.0) for i in range(1, 6))
ROW = Polyline([(0.0, 0.0), (24.0, 0.0)])


def measured(name: str) -> m.LightMeasurement:
    return m.LightMeasurement(name, 100.0, 1.0, m.LightVerdict.OK)


def shown(*names: str, mission_id: str = "x") -> m.MissionStatus:
    return m.MissionStatus(mission_id, "", m.MissionPhase.RUNNING, 0, (), (),
                           tuple(map(measured, names)), "")


@pytest.fixture
def ledger() -> LightLedger:
    made = LightLedger(LIGHTS)
    made.begin("x")
    return made


def test_the_lights_of_a_row_are_those_that_it_passes_over():
    lights = (*LIGHTS, Light("aside", "L", 8.0, 0.5, 1.0), Light("before", "L", -1.0, 0.0, 1.0),
              Light("beyond", "L", 24.3, 0.0, 1.0))
    row = LightLedger(lights).on_row(ROW)
    assert [name for _, name in row] == ["L1", "L2", "L3", "L4", "L5"]
    assert [s for s, _ in row] == pytest.approx([4, 8, 12, 16, 20])
    assert LightLedger(()).on_row(ROW) == ()


def test_a_measurement_is_sent_again_until_it_is_shown(ledger):
    ledger.add(measured("L1"), 0.0)
    ledger.confirm(shown("L2", mission_id="y"))
    assert ledger.judged == {"L1"}
    assert ledger.to_send_again(9.0) == []  # nobody has been heard of this mission
    assert ledger.detour(ledger.on_row(ROW), 10.0, ended=False) is None
    ledger.confirm(shown())
    assert ledger.to_send_again(0.4) == []  # it is on its way
    assert ledger.to_send_again(0.5) == [measured("L1")]
    assert ledger.to_send_again(0.6) == []
    assert ledger.to_send_again(1.0) == [measured("L1")]
    ledger.confirm(shown("L1"))
    assert ledger.to_send_again(9.0) == []


def test_a_light_passed_without_a_measurement_is_gone_back_for_and_then_given_up(ledger):
    row = ledger.on_row(ROW)
    ledger.confirm(shown())
    ledger.add(measured("L1"), 0.0)
    assert ledger.detour(row, 8.0, ended=False) is None  # the sensor is still over L2
    detour = ledger.detour(row, 9.0, ended=False)
    assert (detour.light, detour.to_s_m) == ("L2", pytest.approx(8 - 0.8 - 0.45 - 1.0))
    assert ledger.detour(row, 9.0, ended=False) is None  # passed for the second time
    assert ledger.kept.given_up == ("L2",)
    assert ledger.detour(row, 13.0, ended=False) is None  # blind: L3 is not gone back for
    assert ledger.kept.given_up == ("L2", "L3")
    assert ledger.add(measured("L4"), 0.0)
    assert ledger.detour(row, 22.0, ended=False).light == "L5"  # it sees again
    assert not ledger.is_complete(row)
    ledger.add(measured("L5"), 0.0)
    assert ledger.is_complete(row)


def test_lights_that_it_drives_round_are_left_out_without_taking_the_sensor_for_blind(ledger):
    row = ledger.on_row(ROW)
    ledger.confirm(shown())
    for step in range(40):
        ledger.leave_out(row, 6.0 + 0.1 * step)
    assert ledger.kept.given_up == ("L2",)
    assert ledger.detour(row, 14.0, ended=False).light == "L1"


def test_a_blind_sensor_costs_one_detour_and_every_other_fault_ends(ledger):
    """Random rows, sensors and deaths: each light ends up measured or given up, in bounded time."""
    for seed in range(60):
        dice = random.Random(seed)
        works = {light.name: dice.random() < 0.8 for light in LIGHTS}
        book, manager, s_m, detours = LightLedger(LIGHTS), [], 0.0, 0
        book.begin("x")
        row = book.on_row(ROW)
        missed = {light.name: dice.random() < 0.5 for light in LIGHTS}  # in the first pass
        for _ in range(2000):
            s_m = min(s_m + 0.2, 24.0)
            if dice.random() < 0.002:
                kept, book = book.kept, LightLedger(LIGHTS)
                book.restore(kept)
            book.confirm(shown(*manager))
            for at_m, name in row:
                if 0.9 <= s_m + 0.45 - at_m < 1.1:
                    if works[name] and not missed[name] and book.add(measured(name), 0.0):
                        manager.append(name)
                    missed[name] = False
            detour = book.detour(row, s_m, ended=s_m == 24.0)
            if detour:
                s_m, detours = detour.to_s_m, detours + 1
            if s_m == 24.0 and book.is_complete(row):
                break
        else:
            pytest.fail("it never ended")
        assert len(set(manager)) == len(manager)
        assert set(manager) | set(book.kept.given_up) == set(works)
        assert detours <= len(LIGHTS) + 4
        if all(works.values()):
            assert set(manager) == set(works)
