"""Stuck wheels, weak wheels and failed brakes: what they do, what they count, how they end."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rampart.actors.bus import topics as bus_topics
from rampart.actors.osmosis import messages as m
from rampart.sim.osmosis.actuator_faults import ActuatorFaults, FaultNews, Motor
from rampart.sim.osmosis.robot import WHEEL_NAMES
from rampart.sim.osmosis.scene import WorldError
from rampart.sim.osmosis.world import World
from tests.sim.osmosis.bench import Bench, run, world

STUCK = m.ActuatorFaultKind.STUCK_WHEEL
WEAK = m.ActuatorFaultKind.WEAK_WHEEL
BRAKE = m.ActuatorFaultKind.BRAKE_FAILURE
LEFT = ("front left", "rear left")


def fault(kind, wheel="front left", strength=0.0, duration_s=100.0, injection="f"):
    return m.ActuatorFault(injection, kind, wheel, strength, duration_s)


def driving(linear: float = 1.0, angular: float = 0.0) -> World:
    """A world whose robot has driven for three seconds."""
    return run(world(), linear, angular, 3.0)


def after(sim: World, seconds: float) -> World:
    sim.step_to(sim.time_s + seconds)
    return sim


def turned(sim: World, seconds: float) -> float:
    """Angle turned, rad, over less than half a turn."""
    before = sim.pose[2]
    return math.remainder(after(sim, seconds).pose[2] - before, math.tau)


def way_to_stop(sim: World) -> float:
    """Way, m, from ordering the brake to standstill."""
    start = sim.pose
    sim.brake(True)
    after(sim, 30.0)
    assert abs(sim.truth().twist.linear_mps) < 0.005
    return math.dist(start[:2], sim.pose[:2])


def model_of(sim: World) -> tuple[bytes, ...]:
    """All of the model that a fault may change."""
    model = sim._model
    return tuple(a.tobytes() for a in (
        model.dof_damping, model.actuator_forcerange, model.actuator_gainprm,
        model.actuator_biasprm, model.dof_frictionloss, model.geom_friction))  # fmt: skip


def affected(sim: World, injection: str = "f") -> int:
    """End a fault and return in how many ticks it changed something."""
    sim.order_fault(fault(STUCK, duration_s=0.0, injection=injection))
    last = sim.fault_news()[-1]
    assert (last.injection, last.finished) == (injection, True)
    return last.affected_ticks


# ---- stuck wheel --------------------------------------------------------------------


@pytest.mark.parametrize("wheel", WHEEL_NAMES)
def test_a_stuck_wheel_stands_and_pulls_the_robot_to_its_side_and_a_weak_one_less(wheel):
    sim, weak = driving(), driving()
    sim.order_fault(fault(STUCK, wheel))
    weak.order_fault(fault(WEAK, wheel, 0.2))
    side = 1 if wheel in LEFT else -1  # REP-103: counter-clockwise is positive, to the left
    angle = turned(sim, 2.0) * side
    assert angle > 0.5
    speeds = dict(zip(WHEEL_NAMES, sim.base_status().wheel_speeds_radps, strict=True))
    assert abs(speeds.pop(wheel)) < 0.2
    assert min(speeds.values()) > 7.5  # the others turn on at 1 m/s: 8.5 rad/s
    assert 0.4 < sim.truth().twist.linear_mps < 0.9
    assert 0.1 < side * turned(weak, 2.0) < 0.6 * angle


# ---- brake failure ------------------------------------------------------------------


def test_the_less_of_the_brake_is_left_the_longer_the_way():
    ways = [way_to_stop(driving())]
    for strength in (0.5, 0.1, 0.0):
        sim = driving()
        sim.order_fault(fault(BRAKE, wheel="", strength=strength))
        ways.append(way_to_stop(sim))
    assert ways == sorted(ways)
    assert ways[1] > 1.4 * ways[0]
    # Bearings only: 0.1 N m s/rad a wheel on 84 kg, wheels' inertia included, at 1 m/s.
    assert ways[-1] == pytest.approx(84 * 0.1175**2 / (4 * 0.1), rel=0.1)


def test_the_dead_man_brakes_in_vain_as_well_but_a_controlled_stop_does_not_need_the_brake():
    sim = world(dead_man_timeout_s=0.4)
    sim.order_fault(fault(BRAKE))
    while sim.time_s < 3.0:
        sim.command(1.0, 0.0)
        after(sim, 0.1)
    after(sim, 1.5)
    assert sim.base_status().dead_man_tripped
    assert sim.truth().twist.linear_mps > 0.5
    for _ in range(10):
        sim.command(0.0, 0.0)
        after(sim, 0.1)
    assert abs(sim.truth().twist.linear_mps) < 0.01


def test_when_the_brake_is_released_the_drive_goes_on_from_the_speed_that_is_left():
    sim = driving()
    sim.order_fault(fault(BRAKE))
    sim.brake(True)
    speed = after(sim, 2.0).truth().twist.linear_mps
    assert 0.4 < speed < 0.6
    sim.brake(False)
    assert after(sim, 0.1).truth().twist.linear_mps < speed + 0.2  # 1.5 m/s^2, and no jerk to 1 m/s
    assert after(sim, 2.0).truth().twist.linear_mps == pytest.approx(1.0, abs=0.01)


# ---- several, and their ends --------------------------------------------------------


@pytest.mark.parametrize("orders", [
    [fault(STUCK, duration_s=1.0)],
    [fault(WEAK, strength=0.1, duration_s=1.0)],
    [fault(STUCK, "rear right", duration_s=1.0, injection="a"),
     fault(WEAK, "front left", 0.2, 0.7, "b"), fault(BRAKE, "", 0.3, 0.4, "c")],
])  # fmt: skip
def test_a_fault_ends_by_its_duration_and_the_robot_drives_straight_again(orders):
    sim = driving()
    for order in orders:
        sim.order_fault(order)
    assert model_of(after(sim, 0.3)) != model_of(world())
    after(sim, 2.0)
    assert model_of(sim) == model_of(world())
    assert not sim._faulty  # and the ticks cost what they did before
    assert abs(turned(sim, 3.0)) < 0.002
    assert sim.truth().twist.linear_mps == pytest.approx(1.0, abs=0.01)


def test_a_duration_of_0_ends_one_fault_and_leaves_the_other():
    sim = driving()
    sim.order_fault(fault(STUCK, "front left", injection="a"))
    sim.order_fault(fault(STUCK, "rear left", injection="b"))
    after(sim, 0.2)
    assert affected(sim, "a") == 20
    after(sim, 0.3)
    speeds = sim.base_status().wheel_speeds_radps
    assert speeds[0] > 7.5
    assert abs(speeds[2]) < 0.2
    assert affected(sim, "b") == affected(sim, "b") == 50, "also when it is ended twice"
    assert model_of(after(sim, 0.01)) == model_of(world())


def test_a_fault_ordered_again_is_replaced_lasts_anew_and_goes_on_counting():
    sim = driving()
    sim.order_fault(fault(STUCK, "front left", duration_s=0.5))
    after(sim, 0.3)
    sim.order_fault(fault(STUCK, "rear right", duration_s=0.5))
    after(sim, 0.4)
    assert sim.base_status().wheel_speeds_radps[0] > 7.5
    assert abs(sim.base_status().wheel_speeds_radps[3]) < 0.2
    after(sim, 1.0)
    assert sim.fault_news()[-1] == FaultNews("f", 80, finished=True)


def test_the_worst_of_several_faults_on_an_actuator_acts_and_counts():
    sim = driving()
    for injection, order in {
        "stuck": fault(STUCK), "hidden": fault(WEAK, strength=0.1),
        "weakest": fault(WEAK, "rear right", 0.1), "weaker": fault(WEAK, "rear right", 0.2),
    }.items():  # fmt: skip
        sim.order_fault(m.ActuatorFault(injection, order.kind, order.wheel, order.strength, 9.0))
    after(sim, 0.5)
    counts = {name: affected(sim, name) for name in ("stuck", "hidden", "weakest", "weaker")}
    assert counts == {"stuck": 50, "hidden": 0, "weakest": 50, "weaker": 0}


# ---- what changes nothing -----------------------------------------------------------


@pytest.mark.parametrize("order", [fault(STUCK), fault(WEAK), fault(BRAKE, strength=0.5)])
def test_on_a_robot_that_stands_braked_no_fault_has_an_effect(order):
    sim = world()
    sim.brake(True)
    after(sim, 0.5)
    sim.order_fault(order)
    after(sim, 1.0)
    assert affected(sim) == 0


# ---- bad input ----------------------------------------------------------------------

BAD = [
    (fault(STUCK, "middle left"), "wheel = 'middle left': expected one of front left"),
    (fault(WEAK, strength=-0.1), "strength = -0.1: expected a share from 0 to 1"),
    (fault(BRAKE, strength=math.nan), "strength = nan: expected a share"),
    (fault(STUCK, duration_s=math.nan), "duration_s = nan: expected seconds"),
    (fault(STUCK, duration_s=0.0), "injection = 'f': unknown fault, nothing to end")]


@pytest.mark.parametrize(("order", "reason"), BAD)
def test_an_impossible_fault_is_refused_in_one_line_and_changes_nothing(order, reason):
    sim = driving()
    with pytest.raises(WorldError) as refusal:
        sim.order_fault(order)
    assert reason in str(refusal.value)
    assert "\n" not in str(refusal.value)
    assert sim.fault_news() == []
    assert after(sim, 0.1).truth() == after(driving(), 0.1).truth()


# ---- the pure part ------------------------------------------------------------------

MOTOR = Motor(torque_nm=30.0, servo_gain=100.0, rated_radps=25.0, brake_torque_nm=12.0)
radps = st.floats(-40, 40)
wheels4 = st.tuples(radps, radps, radps, radps)
orders = st.builds(
    m.ActuatorFault, st.sampled_from("abcd"), st.sampled_from(m.ActuatorFaultKind),
    st.sampled_from(WHEEL_NAMES), st.floats(0, 1),
    st.integers(1, 100).map(lambda ticks: ticks / 100))  # fmt: skip


@settings(deadline=None)
@given(st.lists(orders, max_size=4), wheels4, wheels4, st.booleans())
def test_no_wheel_gets_more_than_a_healthy_one_and_only_faulty_wheels_get_less(
    faults, targets, speeds, braking
):
    subject = ActuatorFaults(MOTOR)
    in_force = {order.injection: order for order in faults}
    for order in faults:
        subject.order(order, 0.0)
    actuation = subject.actuate(targets, speeds, braking)
    kept = [o.strength for o in in_force.values() if o.kind == BRAKE]
    fails = braking and min(kept, default=1.0) < 1
    for i, wheel in enumerate(WHEEL_NAMES):
        own = [o for o in in_force.values() if o.kind != BRAKE and o.wheel == wheel]
        stuck = any(o.kind == STUCK for o in own)
        share = min((o.strength for o in own if o.kind == WEAK), default=1.0)
        assert actuation.blocked[i] == stuck
        least, most = actuation.torques_nm[i]
        assert -30.0 <= least <= 0.0 <= most <= 30.0
        assert abs(actuation.targets_radps[i]) <= abs(targets[i])
        if fails:  # absorbs only
            assert (least if speeds[i] <= 0 else most) == 0.0
            assert max(-least, most) <= min(kept) * 12.0
        elif not stuck:
            assert (-least, most) == (share * 30.0, share * 30.0)
            if share == 1 or abs(targets[i]) <= share * 25.0:
                assert actuation.targets_radps[i] == targets[i]


# ---- the actor ----------------------------------------------------------------------


def reports(bench: Bench) -> list[tuple[str, int, bool, str]]:
    return [(r.injection, r.affected, r.finished, r.reason)
            for r in bench.all(bus_topics.INJECTION_REPORT)]


def ordered(order: m.ActuatorFault) -> Bench:
    """A simulator whose robot drives when a fault is ordered."""
    bench = Bench()
    bench.run(1.0, FORWARD)
    bench.actor.actuator_fault(order, bench.header())
    return bench


FORWARD = m.BaseCommand(1.0, 0.0)


def test_the_simulator_reports_when_a_fault_is_taken_when_it_bites_and_when_it_is_over():
    bench = ordered(fault(STUCK, duration_s=0.5))
    assert reports(bench) == [("f", 0, False, "")]
    bench.run(0.1, FORWARD)
    assert reports(bench)[1:] == [("f", 1, False, "")]
    bench.run(1.0, FORWARD)
    assert reports(bench)[2:] == [("f", 50, True, "")]
    assert bench.complaints == []


def test_the_simulator_refuses_what_is_impossible_and_says_why():
    order, reason = BAD[0]
    bench = ordered(order)
    ((injection, count, finished, why),) = reports(bench)
    assert (injection, count, finished) == ("f", 0, True)
    assert reason in why
    assert bench.complaints == [("actuator fault", why, "tester")]
