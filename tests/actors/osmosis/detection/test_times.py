"""What the shipped spec promises of the modules without a timeout is what they need at the longest.

`within_s` is what the time budget is reckoned with; the constants that make it up stand in the
modules. Here each is driven into its slowest case.
"""

from __future__ import annotations

import pytest

from rampart.actors.osmosis.detection.actuator_failure import ActuatorMonitor
from rampart.actors.osmosis.detection.command_disagreement import CommandComparison
from rampart.actors.osmosis.detection.pilot_output import PilotOutputMonitor
from tests.manager.bench import full_system

PERIOD_S = 0.05
PROMISED_S = {detection.name: detection.within_s for detection in full_system().detections}
RESPAWN_S = full_system().timing.respawn_s


def compare(active: tuple[float, float], standby: tuple[float, float]) -> list[float]:
    """Return when DM9 names one instance and then the other; the active one is wrong."""
    monitor = CommandComparison(("standby_control", "osmosis_control"))
    accused_s: dict[tuple[str, ...], float] = {}
    standby_life, back_s = 1, 0.0
    for tick in range(200):
        now_s = tick * PERIOD_S
        monitor.take("osmosis_control", active, now_s, 1, now_s)
        if now_s >= back_s:
            monitor.take("standby_control", standby, now_s, standby_life, now_s)
        if monitor.nodes and monitor.nodes not in accused_s:
            accused_s[monitor.nodes] = now_s
            if len(accused_s) == 1:  # it is respawned
                standby_life, back_s = 2, now_s + RESPAWN_S
    assert list(accused_s) == [("standby_control#1",), ("osmosis_control#1",)]
    return list(accused_s.values())


def test_dm9_knows_which_speed_is_wrong_in_its_time_and_a_turn_rate_far_sooner():
    first_s, second_s = compare((0.9, 0.0), (0.4, 0.0))
    assert 2.0 <= first_s < second_s
    # The respawn between the two is the budget's, which counts one for each recovery.
    assert second_s - RESPAWN_S <= PROMISED_S["DM9"] <= second_s - RESPAWN_S + 0.2
    first_s, second_s = compare((0.5, 0.9), (0.5, 0.0))
    assert second_s < 2.0


@pytest.mark.parametrize("stuck", [(0.8, 0.0), (0.0, 0.7)])
def test_dm12_finds_an_output_that_is_stuck_in_its_time(stuck):
    monitor = PilotOutputMonitor("safety_pilot", 0.0, 5.0)
    found_s = None
    for tick in range(60):
        now_s = tick * PERIOD_S
        monitor.commanded(*(stuck if now_s < 1.0 else (0.0, 0.0)), now_s)
        monitor.sent(*stuck, now_s, 1, now_s)
        if monitor.active and found_s is None:
            found_s = now_s
    last_asked_s = 1.0 - PERIOD_S
    assert found_s - last_asked_s <= PROMISED_S["DM12"] + 1e-9
    assert found_s - last_asked_s > 0.5 * PROMISED_S["DM12"]


def test_dm13_finds_a_speed_that_is_not_the_one_commanded_in_its_time_and_a_wheel_sooner():
    wheel_radps = 0.8 / 0.1175

    def found_s(first_radps: float, ground_mps: float) -> float:
        monitor, now_s = ActuatorMonitor(), 0.0
        while not monitor.active:
            now_s += PERIOD_S
            monitor.commanded(0.8, 0.0, now_s)
            monitor.moved(ground_mps, 0.0, now_s)
            monitor.status((first_radps, *(wheel_radps,) * 3), braking=False, now_s=now_s)
            assert now_s < 5.0
        return now_s

    assert 0.8 * PROMISED_S["DM13"] < found_s(wheel_radps, 0.3) <= PROMISED_S["DM13"]
    assert found_s(0.0, 0.8) <= 0.65
