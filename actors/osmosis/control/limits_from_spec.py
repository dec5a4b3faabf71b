"""Converts the system spec to the settings of the control cores.

Settings that a spec does not have, such as gains and look-ahead distances, keep their defaults.
"""

from __future__ import annotations

from rampart.actors.osmosis.control.following.path_follower import MotionLimits
from rampart.actors.osmosis.control.pilot.laser_pair import TOLERANCE_M, LaserReach
from rampart.actors.osmosis.control.pilot.safety_gate import Checks, GateLimits
from rampart.actors.osmosis.control.pilot.swept_path import StoppingRoom
from rampart.actors.osmosis.control.polyline import Hull
from rampart.manager.spec.specification import SystemSpec

COMFORT_MPS2 = 0.8
"""Acceleration and braking of the controller; the Safety Pilot uses those of the robot."""


def hull_of(system: SystemSpec) -> Hull:
    """Return the robot's footprint."""
    return Hull(system.robot.length_m, system.robot.width_m)


def motion_of(system: SystemSpec) -> MotionLimits:
    """Return the limits of Osmosis Control's commands."""
    robot = system.robot
    return MotionLimits(
        robot.top_speed_mps, robot.top_turn_rate_radps,
        acceleration_mps2=min(COMFORT_MPS2, robot.acceleration_mps2),
        deceleration_mps2=min(COMFORT_MPS2, robot.braking_mps2))


def gate_of(system: SystemSpec) -> GateLimits:
    """Return the bounds and timeouts that the Safety Pilot enforces."""
    robot, timing = system.robot, system.timing
    room = StoppingRoom(
        hull_of(system), robot.top_speed_mps, robot.stop_distance_m, robot.lateral_distance_m,
        robot.braking_mps2, reaction_s=timing.control_period_s + timing.actuation_s)
    return GateLimits(
        robot.top_speed_mps, robot.top_turn_rate_radps, room=room,
        command_timeout_s=timing.command_timeout_s, scan_timeout_s=timing.scan_timeout_s,
        manager_timeout_s=timing.manager_timeout_s)


def reach_of(system: SystemSpec) -> LaserReach:
    """Return the least coverage of a laser sweep."""
    robot = system.robot
    within_m = min(robot.length_m, robot.width_m) / 2 - TOLERANCE_M
    return LaserReach(robot.sensing_range_m, robot.sensing_field_rad, robot.sensing_gap_rad,
                      max(0.0, within_m))


def checks_of(system: SystemSpec) -> Checks:
    """Return which checks of the Safety Pilot the spec's layers enable."""
    layers = system.layers
    return Checks(layers.safety_pilot_checks, layers.manager_watch and layers.ftm)
