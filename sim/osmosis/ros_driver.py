"""The driver of a Summit XL that speaks ROS 2, and the world behind it: MuJoCo, as ever.

In the place of `Simulator`: the same world, whose sensors are topics of ROS 2 and which hears its
commands there. Only what a judge is told passes by the system's own bus.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import count
from typing import Any

import msgspec

from rampart.actors.bus.topic import Topic
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.ros2.side import Side
from rampart.actors.ros2.stand_in import side_of, wall_ns
from rampart.actors.ros2.translation.tables import ROUTER
from rampart.actors.ros2.wire import Qos
from rampart.actors.runtime.actor import Context, Header
from rampart.sim.osmosis.ros_format import Graph, Reader, Writer, attachment
from rampart.sim.osmosis.simulator import Simulator

NODE = "summit_xl_driver"
DATUM_DEG = (43.635, 1.368)
"""Latitude and longitude of the origin of the map: Toulouse-Blagnac, the paper's airport."""

_METRES_PER_DEGREE = (111_105.117740, 80_696.255885)
"""North and east there, on the ellipsoid WGS 84."""

_HASHES = {
    "nav_msgs/Odometry": "3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0",
    "sensor_msgs/Imu": "7d9a00ff131080897a5ec7e26e315954b8eae3353c3f995c55faf71574000b5b",
    "sensor_msgs/LaserScan": "64c191398013af96509d518dac71d5164f9382553fce5c1f8cca5be7924bd828",
    "sensor_msgs/NavSatFix": "62223ab3fe210a15976021da7afddc9e200dc9ec75231c1b6a557fc598a65404",
    "geometry_msgs/TwistStamped":
        "5f0fcd4f81d5d06ad9b4c4c63e3ea51b82d6ae4d0558f1d475229b1121db6f64",
    "geometry_msgs/TwistWithCovarianceStamped":
        "77b67434531e6529b7a0091357b186b6ebdb17fd9ffd3e0c7ce9d3fb11a44563",
    "sensor_msgs/Illuminance": "b954b25f452fcf81a91c9c2a7e3b3fd85c4c873d452aecb3cfd8fd1da732a22d",
    "geometry_msgs/PoseStamped":
        "10f3786d7d40fd2b54367835614bff85d4ad3b5dab62bf8bca0cc232d73b4cd8",
    "summit_xl_msgs/BaseStatus": "38a792a9e78eb0f25e7aa66ddaffea94f3c666a5d49915cf8059dc7067125498",
    "summit_xl_msgs/Brake": "be8230859cd383cfdd385a23fe67941120fe045851e828f31fbc9c41d32200e1",
}
"""Official hashes (REP-2016) of Jazzy and Kilted, and those of the driver's own messages."""


class RosDriver(Simulator):
    """The world of a Summit XL, as a node of ROS 2."""

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
        self._side: Side | None = None
        self._said: dict[str, Callable[[bytes], None]] = {}

    def listens(self, topic: Topic[Any]) -> bool:
        """Whether it hears a topic of the system: it is commanded from ROS 2."""
        return topic not in {topics.BASE_COMMAND, topics.BRAKE}

    def on_start(self) -> None:
        """Build the world, and enter the graph."""
        super().on_start()
        side = self._side = side_of(self, self._bus, self.parameters.connect, "peer")
        graph = self._graph = Graph(side.id, NODE, self.parameters.domain)
        side.token(graph.token)
        for topic, where, of in (
                (topics.ODOMETRY, "/odom", "nav_msgs/Odometry"),
                (topics.IMU, "/imu", "sensor_msgs/Imu"),
                (topics.SCAN, "/scan", "sensor_msgs/LaserScan"),
                (topics.UPPER_SCAN, "/upper_scan", "sensor_msgs/LaserScan"),
                (topics.GPS, "/fix", "sensor_msgs/NavSatFix"),
                (None, "/fix_velocity", "geometry_msgs/TwistWithCovarianceStamped"),
                (topics.LIGHT, "/illuminance", "sensor_msgs/Illuminance"),
                (topics.ABSOLUTE_POSE, "/absolute_pose", "geometry_msgs/PoseStamped"),
                (topics.BASE_STATUS, "/base_status", "summit_xl_msgs/BaseStatus")):
            self._said[topic.key if topic else where] = self._publisher(where, of)
        self._subscribe("/cmd_vel", "geometry_msgs/TwistStamped", self._commanded)
        self._subscribe("/brake", "summit_xl_msgs/Brake", self._braked_by)

    def on_stop(self) -> None:
        """Leave the graph."""
        if self._side is not None:
            self._side.close()

    def _publisher(self, where: str, of: str) -> Callable[[bytes], None]:
        assert self._side is not None  # noqa: S101 for the type checker
        key, token, gid = self._graph.endpoint("MP", where, of, f"RIHS01_{_HASHES[of]}")
        put, numbers = self._side.publisher(key, Qos()), count(1)
        self._side.token(token)
        return lambda payload: put(payload, attachment(next(numbers), wall_ns(self), gid))

    def _subscribe(self, where: str, of: str, heard: Callable[[Reader], None]) -> None:
        assert self._side is not None  # noqa: S101 for the type checker
        key, token, _ = self._graph.endpoint("MS", where, of, f"RIHS01_{_HASHES[of]}")

        def arrived(payload: bytes, _attached: bytes | None) -> None:
            self._dispatcher.put_message(None, lambda: self._read(where, payload, heard))

        self._side.subscribe(key, Qos(), arrived)
        self._side.token(token)

    def _read(self, where: str, payload: bytes, heard: Callable[[Reader], None]) -> None:
        try:
            heard(Reader(payload))
        except ValueError as error:
            self.report_diagnostic("ros2", str(error), where)

    # -- what it hears ----------------------------------------------------------------------------

    def _commanded(self, data: Reader) -> None:
        stamp_ns = int(data.get("i")) * 10**9 + int(data.get("I"))
        data.text()
        forward, _, _, _, _, turn = (data.get("d") for _ in range(6))
        self.command(m.BaseCommand(forward, turn), self._from("/cmd_vel", stamp_ns))

    def _braked_by(self, data: Reader) -> None:
        holder, engaged, reason = data.text(), bool(data.get("?")), data.text()
        self.brake(m.BrakeCommand(engaged, reason), self._from(holder, wall_ns(self)))

    def _from(self, source: str, stamp_ns: int) -> Header:
        """Return the header of what came from ROS 2."""
        behind_s = (wall_ns(self) - stamp_ns) / 1e9 * self.clock.rate
        return Header(source, 0, 0, self.clock.now() - behind_s)

    # -- what it says -----------------------------------------------------------------------------

    def has_readers(self, topic: Topic[Any]) -> bool:
        """Whether somebody may be listening: in ROS 2 that is not asked."""
        return topic.key in self._said or super().has_readers(topic)

    def publish(self, topic: Topic[Any], body: msgspec.Struct, stamp: float | None = None,
                name: str | None = None) -> None:
        """Say a reading to ROS 2, and what is no sensor's to the system."""
        say = self._said.get(topic.key)
        if say is None:
            super().publish(topic, body, stamp, name)
            return
        stamp_ns = wall_ns(self) - int(
            (self.clock.now() - (self.clock.now() if stamp is None else stamp))
            / self.clock.rate * 1e9)
        if isinstance(body, m.GpsFix):  # a receiver says its velocity on a topic of its own
            self._said["/fix_velocity"](
                Writer().header(stamp_ns, "map").put(
                    "d", body.velocity_x_mps, body.velocity_y_mps, 0, 0, 0, 0).zeros(36).done())
        say(_WRITE[type(body)](body, Writer(), stamp_ns))


def _turn(writer: Writer, yaw_rad: float) -> Writer:
    return writer.put("d", 0.0, 0.0, math.sin(yaw_rad / 2), math.cos(yaw_rad / 2))


def _odometry(body: m.Odometry, writer: Writer, stamp_ns: int) -> bytes:
    writer.header(stamp_ns, "odom").text("base_link").put("d", body.pose.x_m, body.pose.y_m, 0.0)
    _turn(writer, body.pose.yaw_rad).zeros(36)
    twist = body.twist
    return writer.put("d", twist.linear_mps, 0, 0, 0, 0, twist.angular_radps).zeros(36).done()


def _imu(body: m.Imu, writer: Writer, stamp_ns: int) -> bytes:
    _turn(writer.header(stamp_ns, "base_link"), body.yaw_rad).zeros(9)
    writer.put("d", 0, 0, body.yaw_rate_radps).zeros(9)
    return writer.put("d", body.accel_x_mps2, body.accel_y_mps2, 0).zeros(9).done()


def _scan(body: m.LaserScan, writer: Writer, stamp_ns: int) -> bytes:
    import numpy as np  # noqa: PLC0415 with the first sweep

    ranges = np.frombuffer(body.ranges_f32, "<f4")
    last = body.angle_min_rad + body.angle_increment_rad * (len(ranges) - 1)
    writer.header(stamp_ns, "base_link").put(
        "f", body.angle_min_rad, last, body.angle_increment_rad, 0, 0.05, 0, body.range_max_m)
    writer.list("f", ranges.tolist())
    return writer.list("f", [body.reference_m]).done()


def _fix(body: m.GpsFix, writer: Writer, stamp_ns: int) -> bytes:
    north_m, east_m = _METRES_PER_DEGREE
    latitude, longitude = DATUM_DEG
    writer.header(stamp_ns, "gps").put("b", 2).put("H", 1)  # an RTK fix, GPS
    writer.put("d", latitude + body.y_m / north_m, longitude + body.x_m / east_m, 0.0)
    variance = body.accuracy_m ** 2
    return writer.put("d", variance, 0, 0, 0, variance, 0, 0, 0, variance).put("B", 2).done()


def _light(body: m.LightSample, writer: Writer, stamp_ns: int) -> bytes:
    return writer.header(stamp_ns, "base_link").put("d", body.illuminance_lux, 0.0).done()


def _pose(body: m.Pose, writer: Writer, stamp_ns: int) -> bytes:
    writer.header(stamp_ns, "map").put("d", body.x_m, body.y_m, 0.0)
    return _turn(writer, body.yaw_rad).done()


def _status(body: m.BaseStatus, writer: Writer, stamp_ns: int) -> bytes:
    writer.header(stamp_ns, "base_link").put("?", body.brake_engaged, body.dead_man_tripped)
    return writer.put("d", body.command_age_s, *body.wheel_speeds_radps).done()


_WRITE: dict[type, Callable[[Any, Writer, int], bytes]] = {
    m.Odometry: _odometry, m.Imu: _imu, m.LaserScan: _scan, m.GpsFix: _fix, m.LightSample: _light,
    m.Pose: _pose, m.BaseStatus: _status}
