"""A simulated driver of a Summit XL that uses ROS 2.

It replaces `Simulator`: the same world, but sensors and commands are ROS 2 topics. Only the ground
truth for the judge uses the system's own bus.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import msgspec

from rampart import systems
from rampart.actors.bus.topic import Topic
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.ros2.node import RosNode
from rampart.actors.ros2.ros_clock import NS
from rampart.actors.ros2.stand_in import side_of, wall_ns
from rampart.actors.ros2.translation.tables import ROUTER
from rampart.actors.ros2.translation.types import Types
from rampart.actors.ros2.wire import Attachment, Qos
from rampart.actors.runtime.actor import Context, Header
from rampart.sim.osmosis.simulator import Simulator

NODE = "summit_xl_driver"
DATUM_DEG = (43.635, 1.368)
"""Latitude and longitude of the origin of the map: Toulouse-Blagnac, the paper's airport."""
_METRES_PER_DEGREE = (111_105.117740, 80_696.255885)
"""North and east at the datum, on the ellipsoid WGS 84."""
_INTERFACES = systems.SHIPPED / "osmosis-ros2"


class _Outlet(NamedTuple):
    """Where readings of a topic go in ROS 2, and how they are written."""

    where: str
    ros_type: str
    write: Callable[[Any, Any], None]
    frame: str = "base_link"


class RosDriver(Simulator):
    """The world of a Summit XL as a ROS 2 node."""

    class Parameters(Simulator.Parameters, frozen=True):
        """Robot and world; see `Simulator.Parameters`.

        Attributes:
            connect: endpoints of the routers of ROS 2.
            domain: ROS_DOMAIN_ID.
        """

        connect: tuple[str, ...] = (ROUTER,)
        domain: int = 0

    parameters: Parameters
    outputs = (topics.TRUTH, topics.OBSTACLES, ftm_topics.HOLDS)

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._types = Types("jazzy", [_INTERFACES])
        self._publishers: dict[str, Callable[[Any, int], None]] = {}

    def listens(self, topic: Topic[Any]) -> bool:
        """Whether it subscribes to a topic: commands come from ROS 2."""
        return topic not in {topics.BASE_COMMAND, topics.BRAKE}

    def on_start(self) -> None:
        """Build the world and join the ROS graph."""
        super().on_start()
        self._side = side_of(self, self._bus, self.parameters.connect, "peer")
        self._ros = RosNode(
            self._side, self._types, NODE, wall_ns=lambda: wall_ns(self), refuse=self._refuse,
            domain=self.parameters.domain)
        for topic, outlet in _OUTLETS.items():
            self._publishers[topic.key] = self._publisher(outlet)
        self._publish_velocity = self._publisher(_VELOCITY)
        self._subscribe("/cmd_vel", "geometry_msgs/msg/TwistStamped", self._commanded)
        self._subscribe("/brake", "summit_xl_msgs/msg/Brake", self._braked_by)

    def on_stop(self) -> None:
        """Leave the ROS graph."""
        self._side.close()

    def _refuse(self, where: str, why: str) -> None:
        self.report_diagnostic("ros2", why, where)

    def _publisher(self, outlet: _Outlet) -> Callable[[Any, int], None]:
        types, ros_type = self._types, outlet.ros_type
        send = self._ros.publisher(outlet.where, ros_type, Qos(depth=10))

        def publish(reading: Any, stamp_ns: int) -> None:
            message = types.blank(ros_type)
            message.header.frame_id = outlet.frame
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, NS)
            outlet.write(message, reading)
            send(types.encode(ros_type, message))

        return publish

    def _subscribe(self, where: str, ros_type: str, heard: Callable[[Any], None]) -> None:
        decode = self._types.decoder(ros_type)

        def read(payload: bytes) -> None:
            try:
                heard(decode(payload))
            except ValueError as error:
                self._refuse(where, str(error))

        def arrived(payload: bytes, _attachment: Attachment) -> None:
            self._dispatcher.put_message(None, lambda: read(payload))

        self._ros.subscribe(where, ros_type, Qos(depth=10), arrived)

    # -- commands ---------------------------------------------------------------------------------

    def _commanded(self, message: Any) -> None:
        stamp, twist = message.header.stamp, message.twist
        self.command(m.BaseCommand(twist.linear.x, twist.angular.z),
                     self._from("/cmd_vel", stamp.sec * NS + stamp.nanosec))

    def _braked_by(self, message: Any) -> None:
        self.brake(m.BrakeCommand(message.engaged, message.reason),
                   self._from(message.holder, wall_ns(self)))

    def _from(self, source: str, stamp_ns: int) -> Header:
        """Return the header for a message from ROS 2."""
        behind_s = (wall_ns(self) - stamp_ns) / 1e9 * self.clock.rate
        return Header(source, 0, 0, self.clock.now() - behind_s)

    # -- sensors ----------------------------------------------------------------------------------

    def has_readers(self, topic: Topic[Any]) -> bool:
        """Whether a topic may have subscribers; assumed for topics of ROS 2."""
        return topic.key in self._publishers or super().has_readers(topic)

    def publish(self, topic: Topic[Any], body: msgspec.Struct, stamp: float | None = None,
                name: str | None = None) -> None:
        """Publish a reading to ROS 2, and all else to the system."""
        send = self._publishers.get(topic.key)
        if send is None:
            super().publish(topic, body, stamp, name)
            return
        stamp_ns = wall_ns(self) - int(
            (self.clock.now() - (self.clock.now() if stamp is None else stamp))
            / self.clock.rate * 1e9)
        if isinstance(body, m.GpsFix):
            self._publish_velocity(body, stamp_ns)
        send(body, stamp_ns)


def _turn(orientation: Any, yaw_rad: float) -> None:
    orientation.z, orientation.w = math.sin(yaw_rad / 2), math.cos(yaw_rad / 2)


def _odometry(message: Any, body: m.Odometry) -> None:
    message.child_frame_id = "base_link"
    _place(message.pose.pose, body.pose)
    message.twist.twist.linear.x = body.twist.linear_mps
    message.twist.twist.angular.z = body.twist.angular_radps


def _place(pose: Any, body: m.Pose) -> None:
    pose.position.x, pose.position.y = body.x_m, body.y_m
    _turn(pose.orientation, body.yaw_rad)


def _imu(message: Any, body: m.Imu) -> None:
    _turn(message.orientation, body.yaw_rad)
    message.angular_velocity.z = body.yaw_rate_radps
    message.linear_acceleration.x = body.accel_x_mps2
    message.linear_acceleration.y = body.accel_y_mps2


def _scan(message: Any, body: m.LaserScan) -> None:
    import numpy as np  # noqa: PLC0415 with the first sweep

    message.ranges = np.frombuffer(body.ranges_f32, "<f4")
    message.angle_min, message.angle_increment = body.angle_min_rad, body.angle_increment_rad
    message.angle_max = body.angle_min_rad + body.angle_increment_rad * (len(message.ranges) - 1)
    message.scan_time, message.range_max = 0.05, body.range_max_m
    message.intensities = Types.numbers([body.reference_m])


def _fix(message: Any, body: m.GpsFix) -> None:
    north_m, east_m = _METRES_PER_DEGREE
    latitude, longitude = DATUM_DEG
    message.status.status, message.status.service = 2, 1  # an RTK fix, GPS
    message.latitude = latitude + body.y_m / north_m
    message.longitude = longitude + body.x_m / east_m
    message.position_covariance[[0, 4, 8]] = body.accuracy_m**2
    message.position_covariance_type = 2


def _velocity(message: Any, body: m.GpsFix) -> None:
    linear = message.twist.twist.linear
    linear.x, linear.y = body.velocity_x_mps, body.velocity_y_mps


def _light(message: Any, body: m.LightSample) -> None:
    message.illuminance = body.illuminance_lux


def _pose(message: Any, body: m.Pose) -> None:
    _place(message.pose, body)


def _status(message: Any, body: m.BaseStatus) -> None:
    message.brake_engaged, message.dead_man_tripped = body.brake_engaged, body.dead_man_tripped
    message.command_age = body.command_age_s
    message.wheel_speeds[:] = body.wheel_speeds_radps


_OUTLETS: dict[Topic[Any], _Outlet] = {
    topics.ODOMETRY: _Outlet("/odom", "nav_msgs/msg/Odometry", _odometry, "odom"),
    topics.IMU: _Outlet("/imu", "sensor_msgs/msg/Imu", _imu),
    topics.SCAN: _Outlet("/scan", "sensor_msgs/msg/LaserScan", _scan),
    topics.UPPER_SCAN: _Outlet("/upper_scan", "sensor_msgs/msg/LaserScan", _scan),
    topics.GPS: _Outlet("/fix", "sensor_msgs/msg/NavSatFix", _fix),
    topics.LIGHT: _Outlet("/illuminance", "sensor_msgs/msg/Illuminance", _light),
    topics.ABSOLUTE_POSE: _Outlet("/absolute_pose", "geometry_msgs/msg/PoseStamped", _pose, "map"),
    topics.BASE_STATUS: _Outlet("/base_status", "summit_xl_msgs/msg/BaseStatus", _status)}
_VELOCITY = _Outlet("/fix_velocity", "geometry_msgs/msg/TwistWithCovarianceStamped", _velocity,
                    "map")
