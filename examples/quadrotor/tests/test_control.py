"""Mixer, rotations and control loops, without a simulation."""

import math

import pytest
from quadrotor import topics as t
from quadrotor.control import AttitudeControl, PositionControl
from quadrotor.rotation import by, leaning, tilt, turn, up
from quadrotor.vehicle import G_MPS2, MASS_KG, MOST_THRUST_N, mix, wrench

LEVEL = (1.0, 0.0, 0.0, 0.0)


def goal(x_m=0.0, y_m=0.0, z_m=5.0, speed_mps=3.0):
    return t.Goal(True, x_m, y_m, z_m, 0.0, speed_mps, 1.0)


@pytest.mark.parametrize(("thrust_n", "torque_nm"), [
    (MASS_KG * G_MPS2, (0.0, 0.0, 0.0)), (12.0, (0.3, -0.2, 0.02)), (18.0, (-0.5, 0.4, -0.03))])
def test_what_is_mixed_gives_the_thrust_and_the_torques_asked_for(thrust_n, torque_nm):
    thrust, torque = wrench(mix(thrust_n, torque_nm))
    assert thrust == pytest.approx(thrust_n)
    assert torque == pytest.approx(torque_nm)


@pytest.mark.parametrize("thrust_n", [0.0, 5.0, 29.0, 100.0])
@pytest.mark.parametrize("torque_nm", [(9.0, 0.0, 0.0), (0.8, -0.8, 0.5), (0.0, 0.0, -9.0)])
def test_a_rotor_is_never_asked_for_what_it_cannot_do(thrust_n, torque_nm):
    assert all(0.0 <= f <= MOST_THRUST_N for f in mix(thrust_n, torque_nm))


def test_roll_is_kept_at_the_cost_of_thrust():
    _, torque = wrench(mix(4 * MOST_THRUST_N, (0.5, 0.0, 0.0)))
    assert torque[0] == pytest.approx(0.5)


@pytest.mark.parametrize("yaw_rad", [-2.0, 0.0, 1.0])
def test_an_attitude_leans_where_it_should_and_keeps_the_yaw(yaw_rad):
    axis = (math.sin(0.3), 0.0, math.cos(0.3))
    q = leaning(axis, yaw_rad)
    assert up(q) == pytest.approx(axis)
    assert turn(q, (0.0, 0.0, 1.0)) == pytest.approx(axis)
    assert tilt(q) == pytest.approx(0.3)


def test_a_constant_wind_is_made_up_for():
    control, speed_mps, x_m = PositionControl(), 0.0, 0.0
    for _ in range(3000):
        at = t.Estimate(x_m, 0.0, 5.0, speed_mps, 0.0, 0.0, abs(speed_mps), LEVEL, 0.0)
        speed_mps += (control.step(goal(), at, 0.02)[0] - 0.8) * 0.02
        x_m += speed_mps * 0.02
    assert abs(x_m) < 0.1


def test_a_tilted_vehicle_is_turned_back():
    rolled = by((0.3, 0.0, 0.0))
    thrusts = AttitudeControl().step((0.0, 0.0, 0.0), 0.0, rolled, (0.0, 0.0, 0.0))
    assert wrench(thrusts)[1][0] < -0.1


def test_a_disturbance_that_stays_is_trimmed_and_tells_of_a_weak_rotor():
    control = AttitudeControl()
    for _ in range(100):
        control.step((0.0, 0.0, 0.0), 0.0, LEVEL, (-0.4, 0.0, 0.0))
    assert control.trim > 0.05


def test_who_does_not_fly_takes_over_the_trim_of_the_one_that_does():
    flies, waits = AttitudeControl(), AttitudeControl()
    for tick in range(600):
        rate = (-0.4 if tick < 100 else 0.0, 0.0, 0.0)
        thrusts = flies.step((0.0, 0.0, 0.0), 0.0, LEVEL, rate)
        waits.step((0.0, 0.0, 0.0), 0.0, LEVEL, (0.3, 0.0, 0.0), flies=False)
        if tick % 2 == 0:
            waits.follow(thrusts)
    assert waits.trim == pytest.approx(flies.trim, rel=0.1)
    waits.follow((math.nan,) * 4)
    assert math.isfinite(waits.trim)


def test_on_the_ground_no_trim_is_learnt():
    control = AttitudeControl()
    for _ in range(100):
        control.step((0.0, 0.0, -4.0), 0.0, LEVEL, (-0.4, 0.0, 0.0))
    assert control.trim == 0.0
