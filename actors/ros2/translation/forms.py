"""Common types of ROS 2, ready to be passed on: which quantities are in them, and where. Data.

A quantity is called as fields of messages are called here, by what it is and its unit, so that a
message with a field `yaw_rad` is filled from an odometry without a word. Angles and axes are those
of REP-103 on either side; a message that stands for the robot in the plane has no z.
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
"""Of a position on the globe, where there is a datum."""

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
"""Quantity → how it is read. Of a transform it is read of the one that is meant."""

UNKNOWN: Mapping[str, Mapping[str, tuple[str, float]]] = {
    "sensor_msgs/msg/Imu": {
        "orientation": ("orientation_covariance[0]", -1),
        "angular_velocity": ("angular_velocity_covariance[0]", -1),
        "linear_acceleration": ("linear_acceleration_covariance[0]", -1)},
    "sensor_msgs/msg/NavSatFix": {"position_covariance": ("position_covariance_type", 0)},
    "sensor_msgs/msg/BatteryState": {"current": ("current", math.nan),
                                     "percentage": ("percentage", math.nan)}}
"""Type → field that its sensor may not know → the field and value by which it says so."""

UNBOUNDED = ("sensor_msgs/msg/LaserScan",)
"""Ready types in which infinity is a value: no echo (REP-117)."""

_TEXTS_AND_TRUTHS = {"dead_man": bool, "ranges_f32": bytes, "status": int}


def kind_of(quantity: str) -> type:
    """Return the type of a quantity."""
    return _TEXTS_AND_TRUTHS.get(quantity, float)


def may_be_unknown(kind: str, text: str) -> bool:
    """Whether the sensor may say by convention that it does not know what an expression reads."""
    return any(field in re.findall(r"[a-z_]+", text) for field in UNKNOWN.get(kind, ()))


def _written(quantity: str, text: str) -> tuple[str, str] | None:
    """Return field and expression by which a quantity is written, None if it cannot be."""
    if text.startswith("yaw("):
        return text[len("yaw("):-1], f"quaternion({quantity})"
    return None if "(" in text else (text, quantity)


WRITTEN: Mapping[str, Mapping[str, tuple[str, str]]] = {
    kind: {name: written for name, text in quantities.items()
           if (written := _written(name, text)) is not None}
    for kind, quantities in READY.items()}
"""Quantity → the field of ROS 2 that says it, and how that is read of a message of ours."""
