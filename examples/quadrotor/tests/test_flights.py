"""Whole flights, each with a fault; the verdict is that of the judge, by ground truth."""

import pytest
from flights import fly

VEHICLE = ("weak-rotor@10", "weak-rotor:3@18", "battery-drain@8")
SENSORS = ("gps-bias@10", "gps-drift@8", "gps-dropout@10", "barometer-bias@10",
           "barometer-stuck@4", "imu-bias@8", "imu-noise@8", "imu-stuck@8", "heading-bias@9")
PROCESSES = ("kill:pilot@10", "stop:pilot@11", "wedge:pilot@6.2", "kill:reserve@10",
             "kill:estimator@10", "wedge:estimator@10", "kill:flight_controller@10",
             "stop:flight_controller@10", "kill:mission@10", "wedge:mission@10",
             "kill:ftm_manager@10")
TOPICS = ("drop:rotors/pilot@10", "stuck:rotors/pilot@10", "delay:rotors/pilot@10",
          "stuck:rotors/reserve@10", "drop:setpoint@10",
          "stuck:setpoint@10", "corrupt:setpoint@10", "freeze:estimate@10", "stuck:estimate@10",
          "corrupt:estimate@10", "drop:mission/goal@10", "corrupt:mission/goal@10",
          "stuck:sensors/gps@10", "delay:sensors/gps@10", "corrupt:pilot/status@10")
UNSAFE_WITHOUT = ("battery-drain:16@4", "gps-dropout@10", "stuck:rotors/pilot@10",
                  "stuck:setpoint@10", "stuck:estimate@10")


IN_CI = {"weak-rotor@10", "gps-bias@10", "imu-bias@8", "wedge:pilot@6.2", "corrupt:estimate@10",
         "stuck:rotors/pilot@10"}
"""Flown with every change; the others with `make test-slow`."""


def chosen(faults):
    return [fault if fault in IN_CI else pytest.param(fault, marks=pytest.mark.slow)
            for fault in faults]


def sound(flight):
    assert flight.failures == ()
    assert all(fault.effective for fault in flight.record.faults)
    return flight.judgement


def test_a_round_without_faults_succeeds_and_nobody_intervenes():
    flight = fly()
    assert sound(flight).success
    assert flight.record.decisions == ()
    assert flight.judgement.margins["fence_m"] > 25
    assert flight.judgement.margins["ceiling_m"] > 15


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_on_other_days_it_succeeds_too(seed):
    assert sound(fly(seed=seed)).success


def test_the_same_seed_is_the_same_flight_to_the_byte():
    fly.cache_clear()
    first = fly("kill:pilot@10", seconds=15.0).trace
    fly.cache_clear()
    assert fly("kill:pilot@10", seconds=15.0).trace == first
    assert fly("kill:pilot@10", seconds=15.0, seed=4).trace != first


@pytest.mark.parametrize("fault", chosen([*VEHICLE, *SENSORS, *TOPICS]))
def test_a_fault_does_no_harm(fault):
    assert sound(fly(fault)).safe


@pytest.mark.parametrize("fault", chosen(PROCESSES))
def test_a_process_that_fails_costs_not_even_the_mission(fault):
    assert sound(fly(fault)).success


@pytest.mark.parametrize(("fault", "mechanism", "recovery"), [
    ("weak-rotor@10", "M_TRIM", "R_LAND"), ("gps-bias@10", "M_POSITION", "R_LAND"),
    pytest.param("battery-drain@8", "M_CHARGE", "R_RETURN", marks=pytest.mark.slow),
    pytest.param("gps-dropout@10", "M_GPS_SILENT", "R_HOVER", marks=pytest.mark.slow),
    ("imu-bias@8", "M_IMU", "R_RETURN"), ("kill:pilot@10", "M_PILOT", "R_PILOT"),
    ("kill:estimator@10", "M_ESTIMATE", "R_RESTART"),
    ("stuck:setpoint@10", "M_SETPOINT", "R_RESTART")])
def test_the_mechanism_against_a_fault_is_the_one_that_acts(fault, mechanism, recovery):
    first = fly(fault).record.decisions[0]
    assert first.active == (mechanism,)
    assert first.recoveries == (recovery,)


@pytest.mark.slow
def test_a_short_loss_of_the_gps_costs_a_pause_and_no_more():
    assert sound(fly("gps-dropout@10+2")).success


def test_two_pilots_that_die_together_are_replaced_before_the_rotors_idle():
    assert sound(fly("kill:pilot@10", "kill:reserve@10", seconds=14.0)).safe


@pytest.mark.slow
@pytest.mark.parametrize("fault", ["kill:pilot@10", "wedge:pilot@10", "slow:pilot@10",
                                   "drop:rotors/pilot@10"])
def test_the_reserve_needs_no_mechanism(fault):
    assert sound(fly(fault, ftm=False)).success


@pytest.mark.slow
def test_a_barometer_that_is_right_again_on_the_way_down_does_no_harm():
    assert sound(fly("barometer-bias@9.17+3.6", seed=1777906562)).safe


@pytest.mark.slow
def test_two_faults_at_once_do_no_harm():
    assert sound(fly("drop:estimate@8", "kill:pilot@9")).safe
    assert sound(fly("gps-dropout@8", "imu-bias@9")).safe


@pytest.mark.parametrize("fault", chosen(UNSAFE_WITHOUT))
def test_without_mechanisms_a_fault_does_harm_that_it_does_not_do_with_them(fault):
    assert sound(fly(fault)).safe
    assert fly(fault, ftm=False).judgement.safe is False


@pytest.mark.parametrize("wrong", ["weak-rotor:4", "weak-rotor:0:2", "battery-drain:x",
                                   "weak-rotor:0:0.5:1"])
def test_details_of_a_fault_that_make_no_sense_are_refused(wrong):
    with pytest.raises(ValueError, match="rotor"):
        fly(wrong)
