"""Ready translations of common types of ROS 2: their quantities, and where they are. Data.

Quantities have the names that fields of messages have here, with the unit, so a message with a
field `yaw_rad` is filled from an odometry without a table `fields`. Angles and axes follow REP-103
on both sides. Messages about the robot in the plane have no z.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping

_POSE = {"x_m": "{0}position.x", "y_m": "{0}position.y", "yaw_rad": "yaw({0}orientation)"}
_TWIST = {"linear_mps": "{0}linear.x", "lateral_mps": "{0}linear.y",
          "angular_radps": "{0}angular.z"}


def _at(path: str, quantities: Mapping[str, str]) -> dict[str, str]:
    return {name: text.format(path) for name, text in quantities.items()}


ON_PLANE = {"x_m": "east(latitude, longitude)", "y_m": "north(latitude, longitude)"}
"""Quantities of a position on the globe, if the link has a datum."""

READY: Mapping[str, Mapping[str, str]] = {
    "geometry_msgs/msg/Twist": _at("", _TWIST),
    "geometry_msgs/msg/TwistStamped": _at("twist.", _TWIST),
    "geometry_msgs/msg/TwistWithCovarianceStamped": _at("twist.twist.", _TWIST),
    "geometry_msgs/msg/PoseStamped": _at("pose.", _POSE),
    "geometry_msgs/msg/PoseWithCovarianceStamped": {
        **_at("pose.pose.", _POSE), "position_sd_m": "sqrt(pose.covariance[0])",
        "heading_sd_rad": "sqrt(pose.covariance[35])"},
    "nav_msgs/msg/Odometry": {**_at("pose.pose.", _POSE), **_at("twist.twist.", _TWIST)},
    "sensor_msgs/msg/Imu": {
        "yaw_rad": "yaw(orientation)", "yaw_rate_radps": "angular_velocity.z",
        "accel_x_mps2": "linear_acceleration.x", "accel_y_mps2": "linear_acceleration.y"},
    "sensor_msgs/msg/LaserScan": {
        "angle_min_rad": "angle_min", "angle_increment_rad": "angle_increment",
        "range_min_m": "range_min", "range_max_m": "range_max", "ranges_f32": "ranges",
        "nearest_m": "least(ranges)"},
    "sensor_msgs/msg/NavSatFix": {
        "latitude_deg": "latitude", "longitude_deg": "longitude", "altitude_m": "altitude",
        "accuracy_m": "sqrt(position_covariance[0])", "status": "status.status"},
    "sensor_msgs/msg/Joy": {
        "forward": "axes[1]", "left": "axes[0]", "dead_man": "buttons[4]"},
    "sensor_msgs/msg/BatteryState": {
        "voltage_v": "voltage", "current_a": "current", "charge": "percentage"},
    "sensor_msgs/msg/Illuminance": {"illuminance_lux": "illuminance"},
    "tf2_msgs/msg/TFMessage": {
        "x_m": "transform.translation.x", "y_m": "transform.translation.y",
        "yaw_rad": "yaw(transform.rotation)"},
}
"""Type → quantity → expression that reads it; in a TFMessage from the transform of the link."""

UNKNOWN: Mapping[str, Mapping[str, tuple[str, float]]] = {
    "sensor_msgs/msg/Imu": {
        "orientation": ("orientation_covariance[0]", -1),
        "angular_velocity": ("angular_velocity_covariance[0]", -1),
        "linear_acceleration": ("linear_acceleration_covariance[0]", -1)},
    "sensor_msgs/msg/NavSatFix": {"position_covariance": ("position_covariance_type", 0)},
    "sensor_msgs/msg/BatteryState": {"current": ("current", math.nan),
                                     "percentage": ("percentage", math.nan)}}
"""Type → field that a sensor may not know → field and value that mark it as unknown."""

UNBOUNDED = ("sensor_msgs/msg/LaserScan",)
"""Ready types in which infinity is a valid value: no echo (REP-117)."""

_TEXTS_AND_TRUTHS = {"dead_man": bool, "ranges_f32": bytes, "status": int}


def kind_of(quantity: str) -> type:
    """Return the Python type of a quantity."""
    return _TEXTS_AND_TRUTHS.get(quantity, float)


def may_be_unknown(kind: str, text: str) -> bool:
    """Return whether a sensor may mark what an expression reads as unknown."""
    return any(field in re.findall(r"[a-z_]+", text) for field in UNKNOWN.get(kind, ()))


def _written(quantity: str, text: str) -> tuple[str, str] | None:
    """Return field of ROS 2 and expression that write a quantity, None if it cannot be written."""
    if text.startswith("yaw("):
        return text[len("yaw("):-1], f"quaternion({quantity})"
    return None if "(" in text else (text, quantity)


WRITTEN: Mapping[str, Mapping[str, tuple[str, str]]] = {
    kind: {name: written for name, text in quantities.items()
           if (written := _written(name, text)) is not None}
    for kind, quantities in READY.items()}
"""Type → quantity → field of ROS 2, and the expression that reads it from our message."""
