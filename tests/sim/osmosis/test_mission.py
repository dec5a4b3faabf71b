"""The shipped mission in the shipped world, driven on ground truth by a few lines of control.

No controller of the product is involved: this shows that airport, robot, light sensor and judge
fit together, and what the mission costs in time.
"""

from __future__ import annotations

import math

import pytest

from rampart.actors.osmosis.airport.formats import load_airport, load_with_truth
from rampart.actors.osmosis.airport.photometry import illuminance_per_candela, sensor_position
from rampart.sim.osmosis.sensors import LightSensor
from rampart.sim.osmosis.trial.record import Judge
from rampart.sim.osmosis.world import World

AIRPORT = load_airport("vallombre")
WAY = ["S0", "W1", "W2", "W3", "A1", "A4", "E1", "E2", "E3", "B1", "B3", "S1", "S0"]
MODES = {"A4": "light verification", "B3": "light verification"}


def drive(sim: World, judge: Judge, cruise_mps: float = 0.9):
    """Go from node to node; return the best intensity estimate of each light that was passed."""
    best: dict[str, tuple[float, float]] = {}
    for node in WAY[1:]:
        to = AIRPORT.nodes[node]
        mode = MODES.get(node, "taxi")
        while (gap_m := math.dist(sim.pose[:2], to)) > 0.8:
            x, y, yaw = sim.pose
            error = math.remainder(math.atan2(to[1] - y, to[0] - x) - yaw, math.tau)
            slow = max(0.0, 1 - abs(error)) * min(1.0, 0.4 + gap_m / 3)
            sim.command(cruise_mps * slow, max(-1.0, min(1.0, 2.0 * error)))
            sim.step_to(sim.time_s + 0.05)
            truth, lux = sim.truth(), sim.light()
            at = sensor_position(*sim.pose)
            for light in AIRPORT.lights:
                off_m = math.dist(at, (light.x_m, light.y_m))
                if off_m < min(0.3, best.get(light.name, (math.inf, 0))[0]):
                    clean = max(0.0, lux - LightSensor.AMBIENT_LUX)
                    best[light.name] = (off_m, clean / illuminance_per_candela(off_m))
            judge.see(truth, mode, sim.time_s)
            assert sim.time_s < 300
    return {name: intensity for name, (_, intensity) in best.items()}


def test_mission_ab_is_a_safe_success_within_200_s_and_every_light_is_measured_right():
    truth = load_with_truth("vallombre")[1]
    sim, judge = World(AIRPORT, truth, seed=3), Judge(AIRPORT.missions["AB"].goals)
    measured = drive(sim, judge)
    verdict = judge.verdict()
    assert verdict.success
    assert verdict.safe
    assert judge.prohibited_m > 1.0
    assert sim.time_s < 195
    real = truth.intensity_cd(AIRPORT)
    assert measured.keys() == real.keys()
    for name, intensity in measured.items():
        assert intensity == pytest.approx(real[name], abs=0.06 * 200), name


def test_driving_blindly_into_the_first_obstacles_is_a_collision_and_the_judge_says_so():
    sim, judge = World(AIRPORT, obstacles=2), Judge(AIRPORT.missions["AB"].goals)
    sim.command(0.8, 0.0)
    for _ in range(40):
        x, y, yaw = sim.pose
        crate = AIRPORT.obstacles[0]
        error = math.remainder(math.atan2(crate.y_m - y, crate.x_m - x) - yaw, math.tau)
        sim.command(0.8, max(-1.0, min(1.0, 2 * error)))
        sim.step_to(sim.time_s + 0.35)
        judge.see(sim.truth(), "taxi", sim.time_s)
    assert not judge.verdict().safe
    assert any("collision" in reason for reason in judge.verdict().reasons)
