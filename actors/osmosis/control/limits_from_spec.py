"""From the system spec to the settings of the control cores: one place, no numbers of its own.

What a spec does not say (gains, look-ahead distances) keeps the default of its core.
"""

from __future__ import annotations

from rampart.actors.osmosis.control.following.path_follower import MotionLimits
from rampart.actors.osmosis.control.pilot.laser_pair import TOLERANCE_M, LaserReach
from rampart.actors.osmosis.control.pilot.safety_gate import Checks, GateLimits
from rampart.actors.osmosis.control.pilot.swept_path import StoppingRoom
from rampart.actors.osmosis.control.polyline import Hull
from rampart.manager.spec.specification import SystemSpec

COMFORT_MPS2 = 0.8
"""Acceleration and braking that the controller plans with; the pilot counts on the robot's own."""


def hull_of(system: SystemSpec) -> Hull:
    """Return the robot's footprint."""
    return Hull(system.robot.length_m, system.robot.width_m)


def motion_of(system: SystemSpec) -> MotionLimits:
    """Return what Osmosis Control asks of the robot at most."""
    robot = system.robot
    return MotionLimits(
        robot.top_speed_mps, robot.top_turn_rate_radps,
        acceleration_mps2=min(COMFORT_MPS2, robot.acceleration_mps2),
        deceleration_mps2=min(COMFORT_MPS2, robot.braking_mps2))


def gate_of(system: SystemSpec) -> GateLimits:
    """Return the bounds and ages that the Safety Pilot enforces."""
    robot, timing = system.robot, system.timing
    room = StoppingRoom(
        hull_of(system), robot.top_speed_mps, robot.stop_distance_m, robot.lateral_distance_m,
        robot.braking_mps2, reaction_s=timing.control_period_s + timing.actuation_s)
    return GateLimits(
        robot.top_speed_mps, robot.top_turn_rate_radps, room=room,
        command_timeout_s=timing.command_timeout_s, scan_timeout_s=timing.scan_timeout_s,
        manager_timeout_s=timing.manager_timeout_s)


def reach_of(system: SystemSpec) -> LaserReach:
    """Return what every sweep of a laser has to cover."""
    robot = system.robot
    within_m = min(robot.length_m, robot.width_m) / 2 - TOLERANCE_M
    return LaserReach(robot.sensing_range_m, robot.sensing_field_rad, robot.sensing_gap_rad,
                      max(0.0, within_m))


def checks_of(system: SystemSpec) -> Checks:
    """Return which of the Safety Pilot's checks the spec's layers leave in force."""
    layers = system.layers
    return Checks(layers.safety_pilot_checks, layers.manager_watch and layers.ftm)
