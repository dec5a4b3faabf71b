"""Targets: bytes that arrive from ROS 2."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

from rampart.actors.bus.bounds import clip
from rampart.actors.bus.envelope import Header, decode, encode
from rampart.actors.bus.topic import Topic
from rampart.actors.ros2.translation.forms import READY
from rampart.actors.ros2.translation.mapping import TF, Inward, NotMeantError, topic_of
from rampart.actors.ros2.translation.tables import Ros2Link
from rampart.actors.ros2.translation.types import Types
from rampart.actors.ros2.wire import (
    Attachment,
    Endpoint,
    EndpointKind,
    Qos,
    RosGraph,
    gid_of,
    misfits,
)
from tests.fuzz.target import target

_TYPES = (*sorted(READY), "nav_msgs/msg/OccupancyGrid", "diagnostic_msgs/msg/DiagnosticArray",
          "nav2_msgs/action/NavigateToPose_FeedbackMessage", "std_msgs/msg/String")


@cache
def types() -> Types:
    return Types("jazzy")


@cache
def link(number: int) -> tuple[Topic[Any], str, Inward]:
    kind = _TYPES[number % len(_TYPES)]
    frames = {"frame": "map", "child": "odom"} if kind == TF else {}
    table = Ros2Link(type=kind, subscribe="/heard", to="heard", datum=(43.6, 1.4), **frames)
    topic = topic_of(table, types())
    return topic, kind, Inward(table, types(), topic.type)


def messages() -> Sequence[bytes]:
    """Return a message of every type, the number of the type before it."""
    return [bytes([number]) + types().encode(kind, types().blank(kind))
            for number, kind in enumerate(_TYPES)]


@target("ros-message", refuses=(ValueError, NotMeantError), samples=messages)
def ros_message(data: bytes) -> None:
    """Bytes on a topic of ROS 2: refused in a line, or a message that all readers take."""
    topic, kind, made = link(data[0] if data else 0)
    try:
        body, _stamp_ns = made(types().decoder(kind)(data[1:]))
    except ValueError as error:
        if not clip(str(error)).isprintable():
            raise AssertionError(f"no printable line: {error}") from error
        raise
    decode(topic, encode(Header("gateway", 1, 1, 0.0), body))


_TOKEN = Endpoint(0, "ab", "0", "3", EndpointKind.PUBLISHER, "talker", "/robot", "/chatter",
                  "std_msgs::msg::dds_::String_", "RIHS01_0", Qos(depth=10)).token


@target("ros-token", refuses=(ValueError,), form="text", one_line=True,
        words=("@ros2_lv", "/", "%", "MP", "NN", "SS", ":", ","),
        samples=lambda: [_TOKEN.encode(), b"@ros2_lv/0/ab/0/0/NN/%/%/talker"])
def ros_token(data: bytes) -> None:
    """A liveliness token: it comes, it is told, and it goes."""
    token, graph = data.decode(errors="replace"), RosGraph()
    found = graph.changed(token, alive=True)
    if found is None or graph.endpoint(gid_of(token)) is not found:
        raise AssertionError("came, and is not there")
    list(misfits(graph.of(*EndpointKind), graph.of(*EndpointKind)))
    if graph.changed(token, alive=False) is not found or graph.nodes():
        raise AssertionError("went, and is there")


@target("ros-attachment", refuses=(ValueError,), one_line=True,
        samples=lambda: [Attachment(7, 1_700_000_000_000_000_000, bytes(16)).pack(), b""])
def ros_attachment(data: bytes) -> None:
    """What goes with a message."""
    if Attachment.unpack(data).pack() != data:
        raise AssertionError("another one comes back")
