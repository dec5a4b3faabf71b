"""Targets: what arrives from buses, ROS 2, sockets, devices, the kernel, browsers, and the past."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

import msgspec

from rampart.actors.bus.bounds import clip
from rampart.actors.bus.envelope import UNREADABLE, ArrivalGuard, Header, decode, encode
from rampart.actors.bus.recorder_connection import frame, parse_frame
from rampart.actors.bus.run_info import RunInfo, read_info
from rampart.actors.bus.topic import Topic
from rampart.actors.operator.requests import RefusedError, RequestReader
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.control.following.route_control import CONTROL_STATE
from rampart.actors.osmosis.control.mission.mission_state import MISSION_STATE
from rampart.actors.osmosis.control.planning.graph_planner import ROUTE_STATE
from rampart.actors.osmosis.page.hmi import OSMOSIS_REQUESTS
from rampart.actors.recording.message_form import Forms
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
from rampart.actors.runtime.checkpoint import StateError
from rampart.actors.supervision.process_title import parse_title
from rampart.actors.web.access import Access
from rampart.actors.web.door import Gate
from rampart.actors.web.visitors import Register, Role, Visitor, VisitorError, digest, parse
from rampart.manager.actor import MANAGER_STATE
from tests.fuzz.message_extremes import sample
from tests.fuzz.target import target

# -- the bus ---------------------------------------------------------------------------------------

TOPICS = {topic.at("a") if topic.is_family else topic.at(): topic for topic in topics.ALL}


def payloads() -> list[bytes]:
    """Return a message of every type."""
    return [encode(Header("a", 1, 1, 0.5), sample(topic.type)) for topic in topics.ALL]


@target("envelope", refuses=(), form="msgpack", samples=payloads)
def envelope(data: bytes) -> None:
    """A payload, on every key: refused with a reason or handed over, twice for what is kept."""
    guard = ArrivalGuard(lambda: 1.0)
    heard: list[Any] = []
    for key, topic in TOPICS.items():
        receive = guard.receiver(topic, lambda _key, message: heard.append(message),
                                 lambda _key, reason: heard.append(reason))
        receive(key, data)
        receive(key, data)
    if not heard:
        raise AssertionError("neither handed over nor refused")


@target("recorded", refuses=(), form="msgpack", samples=payloads)
def recorded(data: bytes) -> None:
    """A payload on its way into a recording, and back."""
    for key in (*TOPICS, "rampart/world/strange"):
        text, header, _ = _FORMS.of(key).recorded(data)
        if header is not None and _FORMS.of(key).payload(text) != data:
            raise AssertionError(f"{key}: another payload came back")


@target("tap-frame", refuses=(ValueError,),
        samples=lambda: [frame(1.5, "rampart/localization/pose", b"payload"), frame(0, "", b"")])
def tap_frame(data: bytes) -> None:
    parse_frame(data)
    parse_frame(memoryview(data))


# -- processes -------------------------------------------------------------------------------------


@target("process-title", refuses=(), form="text", words=("rampart[", "/", "] ", " #", "+"),
        samples=lambda: [b"rampart[7400/123] osmosis_control #1", b"rampart[7400/1] a+b #42 x"])
def process_title(data: bytes) -> None:
    parse_title(1, data.rstrip(b"\0").decode(errors="replace"))


@target("run-info", refuses=UNREADABLE, form="json",
        samples=lambda: [msgspec.json.encode(sample(RunInfo))])
def run_info(data: bytes) -> None:
    _ = read_info(data).endpoints


# -- operators -------------------------------------------------------------------------------------


_FORMS = Forms(topics.ALL)
_READER = RequestReader(OSMOSIS_REQUESTS)


@target("page-request", refuses=(RefusedError,), form="json", samples=lambda: [
        b'{"type":"reset","recovery":"RM1"}', b'{"type":"order","action":"pause","reason":"x"}',
        b'{"type":"stick","panel":"Drive","held":true,"ticket":3,"forward":0.5,"left":-1}',
        b'{"type":"inject","fault":"gps-bias","duration_s":5,"permanent":false}',
        b'{"type":"signal","node":"hmi","signal":"KILL"}', b'{"type":"strategy","name":"x"}'])
def page_request(data: bytes) -> None:
    _READER.read(data)
    _READER.read(data.decode(errors="replace"))


_ACCESS = (Access("127.0.0.1", 8080),
           Access("0.0.0.0", 8080, asks=True, tls=True, names=("robot", "*.robot")))
_GATE = Gate(Register([Visitor("anna", Role.DRIVE, digest("t" * 20))]), "", 8080, tls=False)


@target("page-headers", refuses=(), form="text",
        words=("@", "[::1]", ":", "http://", "rampart-8080=", "Bearer ", "localhost", "127.0.0.1"),
        samples=lambda: [b"127.0.0.1:8080", b"http://localhost:8080", b"[::1]:8080",
                         b"Bearer tttttttttttttttttttt", b"rampart-8080=anna|1|ab; a=b"])
def page_headers(data: bytes) -> None:
    """Host, origin, authorization and cookie, as HTTP hands them over: latin-1."""
    text = data.decode("latin-1")
    for access in _ACCESS:
        access.own_host(text)
        access.own_origin(text)
    _GATE.visitor(text, None)
    _GATE.visitor(None, text)
    _GATE.visitor(f"Bearer {text}", None)


@target("page-tokens", refuses=(VisitorError,), form="text", words=("look", "drive", "#", "\n"),
        samples=lambda: [b"anna drive " + b"a" * 64 + b"\n# all\n"])
def page_tokens(data: bytes) -> None:
    """The file of those who have tokens."""
    parse(data.decode("latin-1").splitlines())


# -- a node's own past -----------------------------------------------------------------------------

_STATES = (CONTROL_STATE, MISSION_STATE, ROUTE_STATE, MANAGER_STATE)


@target("checkpoint", refuses=(StateError,), form="msgpack",
        samples=lambda: [msgspec.msgpack.encode(sample(form.kind)) for form in _STATES])
def checkpoint(data: bytes) -> None:
    """Bytes of a state with a sound checksum, of this version, an older and a newer one."""
    refused = []
    for form in _STATES:
        for version in (0, form.version + 1, -1, form.version):
            try:
                form.encode(form.decode(version, data))
            except StateError as error:
                refused.append(error)
    if len(refused) == 4 * len(_STATES):
        raise refused[-1]


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
