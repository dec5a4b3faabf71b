"""The robot's base: how it drives and brakes, and what stuck wheels and failed brakes do to it."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rampart.actors.bus import topics as bus_topics
from rampart.actors.osmosis import messages as m
from rampart.sim.osmosis.actuator_faults import ActuatorFaults, Motor
from rampart.sim.osmosis.robot import WHEEL_NAMES, Drive, DriveLimits, twist_from_wheels
from rampart.sim.osmosis.scene import WorldError
from rampart.sim.osmosis.world import World
from tests.sim.osmosis.bench import Bench, run, world

# ---- drive --------------------------------------------------------------------------


def test_commands_beyond_the_hardware_are_clipped_and_those_not_finite_refused():
    drive = Drive(DriveLimits(), None)
    assert drive.command(99.0, -99.0, 0.0)
    assert not drive.command(math.nan, 0.0, 5.0)
    assert not drive.command(0.0, math.inf, 5.0)
    for _ in range(500):
        speeds = drive.update(0.0, 0.01)
    assert twist_from_wheels(speeds) == pytest.approx((3.0, -3.0))
    assert drive.command_age_s(6.0) == 6.0  # those refused have refreshed nothing


def test_dead_man_timeline():
    drive = Drive(DriveLimits(), 0.4)
    assert drive.dead_man_tripped(0.0)  # nothing has ever been commanded
    drive.command(1.0, 0.0, 1.0)
    assert not drive.dead_man_tripped(1.4)
    assert drive.dead_man_tripped(1.41)
    drive.update(1.41, 0.01)
    assert drive.braking
    drive.command(1.0, 0.0, 1.5)  # commands are back: it lets go by itself
    drive.update(1.5, 0.01)
    assert not drive.braking


# ---- in MuJoCo ----------------------------------------------------------------------


@pytest.mark.parametrize(("linear", "angular"), [
    (1.0, 0.0), (1.0, 0.3), (0.5, -0.8), (-0.5, 0.5), (0.0, -1.0), (0.0, 2.0)])
def test_it_drives_as_it_is_commanded(linear, angular):
    sim = run(world(), linear, angular, 3)
    way_m, turned_rad = 0.0, 0.0
    for _ in range(20):
        x_m, y_m, yaw_rad = sim.pose
        sim.step_to(sim.time_s + 0.05)
        way_m += math.dist(sim.pose[:2], (x_m, y_m))
        turned_rad += math.remainder(sim.pose[2] - yaw_rad, math.tau)
    assert way_m == pytest.approx(abs(linear), rel=0.05, abs=0.02)
    assert turned_rad == pytest.approx(angular, rel=0.05, abs=0.002)


@pytest.mark.parametrize(("brakes", "least_m", "most_m"), [(False, 0.1, 0.25), (True, 0.05, 0.18)])
def test_a_controlled_stop_takes_less_than_25_cm_and_the_brake_less(brakes, least_m, most_m):
    sim = run(world(), 1.0, 0.0, 3)
    x_m = sim.pose[0]
    sim.brake(brakes)
    run(sim, 1.0 if brakes else 0.0, 0.0, 2)
    assert least_m < sim.pose[0] - x_m < most_m
    assert abs(sim.truth().twist.linear_mps) < 0.005
    assert sim.base_status().brake_engaged is brakes


def test_it_stays_on_its_wheels_whatever_is_commanded():
    sim = world()
    for linear, angular in [(3, 3), (-3, 3), (3, -3), (0, 3), (-3, 0), (3, 0)] * 2:
        run(sim, linear, angular, 1.5)
        # Hub height: neither dug in, nor off the ground, nor on its back.
        assert sim._data.qpos[2] == pytest.approx(0.1175, abs=0.02)
        _, qx, qy, _ = sim._data.qpos[3:7]
        assert 1 - 2 * (qx * qx + qy * qy) > 0.98


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


def test_the_dead_man_brakes_in_vain_as_well():
    sim = run(world(dead_man_timeout_s=0.4), 1.0, 0.0, 0.4)
    sim.order_fault(fault(BRAKE))
    after(sim, 1.0)
    assert sim.base_status().dead_man_tripped
    assert 0.3 < sim.truth().twist.linear_mps < 0.5  # it rolls out


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


def test_a_fault_ends_by_its_duration_and_the_robot_drives_straight_again():
    sim = driving()
    for order in (fault(STUCK, "rear right", duration_s=1.0, injection="a"),
                  fault(WEAK, "front left", 0.2, 0.7, "b"), fault(BRAKE, "", 0.3, 0.4, "c")):
        sim.order_fault(order)
    assert model_of(after(sim, 0.3)) != model_of(world())
    after(sim, 2.0)
    assert model_of(sim) == model_of(world())
    assert not sim._faulty  # and the ticks cost what they did before
    assert abs(turned(sim, 3.0)) < 0.002
    assert sim.truth().twist.linear_mps == pytest.approx(1.0, abs=0.01)


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


def news(subject, ticks=0, asked=(8.5,) * 4, speeds=(8.5,) * 4, braking=False):
    """What is new after so many ticks: fault, ticks in which it changed something, it is over."""
    for _ in range(ticks):
        subject.actuate(asked, speeds, braking)
    return [(one.injection, one.affected_ticks, one.finished) for one in subject.take_news()]


def test_faults_are_replaced_and_ended_by_name_and_the_worst_on_an_actuator_counts():
    subject = ActuatorFaults(MOTOR)
    for name, kind, wheel, strength in (
            ("stuck", STUCK, "front left", 0.0), ("hidden", WEAK, "front left", 0.1),
            ("weakest", WEAK, "rear right", 0.1), ("weaker", WEAK, "rear right", 0.2)):
        subject.order(fault(kind, wheel, strength, injection=name), 0.0)
    news(subject, ticks=50)
    subject.order(fault(STUCK, "rear left", duration_s=1.0, injection="stuck"), 0.5)
    assert news(subject, ticks=10) == [("stuck", 50, False), ("hidden", 1, False)]
    subject.expire(1.5)
    for name in ("weaker", "weakest", "weakest"):  # also when it is ended twice
        subject.order(fault(WEAK, duration_s=0.0, injection=name), 1.5)
    assert news(subject) == [("stuck", 60, True), ("weaker", 0, True), ("weakest", 60, True),
                             ("weakest", 60, True)]


@pytest.mark.parametrize("order", [fault(STUCK), fault(WEAK), fault(BRAKE, strength=0.5)])
def test_on_a_robot_that_stands_braked_no_fault_has_an_effect(order):
    subject = ActuatorFaults(MOTOR)
    subject.order(order, 0.0)
    creep = (0.01,) * 4  # rad/s, as friction leaves it
    assert news(subject, 9, (0.0,) * 4, creep, braking=True) == [("f", 0, False)]


BAD = [
    (fault(STUCK, "middle left"), "wheel = 'middle left': expected one of front left"),
    (fault(BRAKE, strength=math.nan), "strength = nan: expected a share"),
    (fault(STUCK, duration_s=math.nan), "duration_s = nan: expected seconds"),
    (fault(STUCK, duration_s=0.0), "injection = 'f': unknown fault, nothing to end")]


@pytest.mark.parametrize(("order", "reason"), BAD)
def test_an_impossible_fault_is_refused_and_changes_nothing(order, reason):
    subject = ActuatorFaults(MOTOR)
    with pytest.raises(WorldError, match=reason):
        subject.order(order, 0.0)
    assert not subject
    assert news(subject) == []


# ---- the actor ----------------------------------------------------------------------


def reports(bench: Bench) -> list[tuple[str, int, bool, str]]:
    return [(r.injection, r.affected, r.finished, r.reason)
            for r in bench.all(bus_topics.INJECTION_REPORT)]


FORWARD = m.BaseCommand(1.0, 0.0)


def test_the_simulator_reports_when_a_fault_is_taken_when_it_bites_when_it_is_over_or_refused():
    bench = Bench()
    bench.run(1.0, FORWARD)
    bench.actor.actuator_fault(fault(STUCK, duration_s=0.5), bench.header())
    assert reports(bench) == [("f", 0, False, "")]
    bench.run(0.1, FORWARD)
    assert reports(bench)[1:] == [("f", 1, False, "")]
    bench.run(1.0, FORWARD)
    assert reports(bench)[2:] == [("f", 50, True, "")]
    assert bench.complaints == []
    order, reason = BAD[0]
    bench.actor.actuator_fault(order, bench.header())
    (name, count, finished, why), = reports(bench)[3:]
    assert (name, count, finished) == ("f", 0, True)
    assert reason in why
    assert bench.complaints == [("actuator fault", why, "tester")]
