"""Targets: files that users give to the program, and what arrives from outside of a process.

That is buses, ROS 2, sockets, devices, the kernel, browsers, and the past.
"""

from __future__ import annotations

import io
import json
import tempfile
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import msgspec
from mcap.writer import CompressionType, Writer
from PIL import Image

from rampart.actors.bus.bounds import clip
from rampart.actors.bus.envelope import UNREADABLE, ArrivalGuard, Header, decode, encode
from rampart.actors.bus.recorder_connection import frame, parse_frame
from rampart.actors.bus.run_info import RunInfo, read_info
from rampart.actors.bus.topic import Topic
from rampart.actors.operator.requests import RefusedError, RequestReader
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.airport.formats import load_airport
from rampart.actors.osmosis.airport.model import AirportError
from rampart.actors.osmosis.control.following.route_control import CONTROL_STATE
from rampart.actors.osmosis.control.mission.mission_state import MISSION_STATE
from rampart.actors.osmosis.control.planning.graph_planner import ROUTE_STATE
from rampart.actors.osmosis.page.hmi import OSMOSIS_REQUESTS
from rampart.actors.recording.bag_reader import BagReader, Summary, repair
from rampart.actors.recording.bag_writer import BagError
from rampart.actors.recording.message_form import Forms, header_of
from rampart.actors.recording.run_documents import recorded_system, restore
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
from rampart.cli.record.record_verbs import described
from rampart.files import toml
from rampart.files.reading import FileError
from rampart.manager.actor import MANAGER_STATE
from rampart.manager.analysis.formula import formula_of
from rampart.manager.analysis.open_psa import OpenPsaError, read_open_psa, write_open_psa
from rampart.manager.model.gates import GateError, detection_gate, recovery_gate
from rampart.manager.spec.adaptation import ChangeError, parse_value
from rampart.manager.spec.specification import parse_specification
from rampart.manager.spec.tables import SpecificationError
from rampart.sim.faults.scenario import ScenarioError, action_of, parse_fault
from rampart.sim.faults.topic_faults import UnknownFaultError
from rampart.sim.osmosis.trial.faults import OsmosisFaults
from tests import CELL, ROOT, TANK
from tests.actors.osmosis.airport.test_formats import GRAPH, TOML
from tests.fuzz.message_extremes import sample
from tests.fuzz.target import target

_CELL = CELL.read_text("utf-8")
_PAPER = (ROOT / "systems/paper.toml").read_text("utf-8")


@cache
def _kept() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="rampart-fuzz-")


def folder() -> Path:
    """Return a folder of this process; a worker's lies in memory."""
    return Path(_kept().name)


def written(name: str, data: bytes) -> Path:
    """Return the path of a file with this content."""
    path = folder() / name
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(data)
    return path


# -- airports and missions -------------------------------------------------------------------------


@target("airport-toml", refuses=(AirportError,), form="toml", one_line=True,
        samples=lambda: [TOML.encode(), (
            "fillet_radius_m = 1.0\n" + TOML + '[[prohibited]]\nname = "P"\n'
            'polygon = [[20, -1], [22, -1], [22, -3]]\n[[building]]\nname = "B"\nx_m = 5.0\n'
            'y_m = 9.0\nlength_m = 2.0\nwidth_m = 2.0\nheight_m = 3.0\n').encode()])
def airport_toml(data: bytes) -> None:
    load_airport(written("airport/field.toml", data))


@target("graph", refuses=(AirportError,), form="json", one_line=True,
        samples=lambda: [json.dumps(GRAPH).encode(), json.dumps({
            "nodes": [*GRAPH["nodes"], {"id": "N3", "x": 5, "y": 4}],
            "edges": [["N1", "N2"], ["N2", "N3"]]}).encode()])
def graph(data: bytes) -> None:
    file = written("foreign/field.graph", data)
    if not (area := file.with_suffix(".png")).exists():
        Image.new("RGB", (960, 960), "lime").save(area)
    load_airport(file)


# -- systems ---------------------------------------------------------------------------------------

@target("toml", refuses=(FileError,), form="toml", one_line=True,
        samples=lambda: [b'a.b = [1, {c = "x"}, 1979-05-27]\n[t]\ns = \'\'\'x\'\'\'\n"q" = """y"""',
                         TOML.encode()])
def toml_document(data: bytes) -> None:
    toml.parse(data.decode(errors="replace"))


@target("system", refuses=(SpecificationError,), form="toml", one_line=True,
        words=("[[node]]\n", "enabled = false\n", "[orders.b]\n", "timeout_s = 1e-9\n", "at_least"),
        samples=lambda: [*[TANK.encode()] * 9, _CELL.encode(), _PAPER.encode()])
def system(data: bytes) -> None:
    spec = parse_specification(data.decode(errors="replace"), "system.toml")
    formula_of(spec.build_fault_tree())
    write_open_psa(spec)


@target("value", refuses=(ChangeError,), form="text", one_line=True,
        samples=lambda: [b"0.5", b"true", b"'text'", b"[1, {a = 2}]", b"guarded-repair"])
def value(data: bytes) -> None:
    parse_value(data.decode(errors="replace"))


@target("gate", refuses=(GateError,), form="text", one_line=True,
        words=(" and ", " or ", "not ", "2 of (", "(", ")", ",", "DM1", "DM2"),
        samples=lambda: [b"DM1 or (DM2 and not DM3)", b"2 of (DM1, DM2, DM3)", b"RM4 or RM3",
                         b"(A or B) and (C or D) and (E or F)"])
def gate(data: bytes) -> None:
    text = data.decode(errors="replace")
    refused = None
    for read in (detection_gate, recovery_gate):
        try:
            found = read.__wrapped__(text)
        except GateError as error:
            refused = error
        else:
            str(found)
            if read is recovery_gate:
                list(found.alternatives())
    if refused is not None:
        raise refused


@target("open-psa", refuses=(OpenPsaError,), form="text", one_line=True,
        words=("<and>", "</and>", "<not>", '<event name="a"/>', "<!DOCTYPE x>", "<![CDATA[",
               '<define-gate name="g">', "&lt;", "<house-event name='h'/>",
               "<constant value='true'/>",
               '<atleast min="2">', "xmlns='x'", "<define-component name='c'>"),
        samples=lambda: [(
            b'<?xml version="1.0"?><opsa-mef><define-fault-tree name="t">'
            b'<define-gate name="top"><or><gate name="g"/><event name="b"/></or></define-gate>'
            b'<define-gate name="g"><atleast min="2"><event name="a"/><event name="b"/>'
            b'<not><event name="c"/></not></atleast></define-gate>'
            b'<define-component name="k" role="private"><define-house-event name="h">'
            b'<constant value="true"/></define-house-event></define-component></define-fault-tree>'
            b'</opsa-mef>')])
def open_psa(data: bytes) -> None:
    read_open_psa(data, "tree.xml")


@target("fault", refuses=(ScenarioError, UnknownFaultError), form="text",
        words=("@", "+", "goal", "inf", ":", "kill", "corrupt:", "localization/pose"),
        samples=lambda: [b"kill:osmosis_control@30", b"gps-bias@goal2+5",
                         b"weak-wheel:front-left:0.2", b"corrupt:localization/pose@goal1:3+inf",
                         b"obstacle-ahead:3",
                         b"slow:hmi:0.1@5+2", b"restamp:plan/route"])
def fault(data: bytes) -> None:
    planned = parse_fault(data.decode(errors="replace"))
    planned.text()
    action_of(planned, "f1", ("osmosis_control", "hmi"), topics.ALL, OsmosisFaults())


# -- recordings, results ---------------------------------------------------------------------------


def recording() -> bytes:
    """Return a recording of another program, with a run's description."""
    out = io.BytesIO()
    writer = Writer(out, compression=CompressionType.NONE, enable_crcs=False, use_statistics=False)
    writer.start("rampart", "fuzz")
    writer.add_metadata("rampart.run", {"title": "t", "time_zero_s": "-3", "nodes": '["a"]'})
    writer.add_attachment(0, 0, "system.toml", "application/toml",
                          b"[robot]\nlength_m = 1.0\nwidth_m = 0.5\n")
    schema = writer.register_schema("Pose", "jsonschema", b"{}")
    channel = writer.register_channel("pose", "json", schema, {"key": "rampart/localization/pose"})
    writer.add_message(channel, 0, b'{"source":"l","incarnation":1,"sequence":1,"stamp":1.0,'
                       b'"body":{"x_m":0,"y_m":0,"yaw_rad":0}}', 0)
    writer.add_metadata("rampart.end", {"lost": '{"a": 1}', "ended": "over"})
    writer.finish()
    return out.getvalue()


@target("mcap", refuses=(BagError,), one_line=True, samples=lambda: [recording()])
def mcap(data: bytes) -> None:
    reader = BagReader(written("bag.mcap", data))
    summary = Summary(reader)
    msgspec.json.encode(described(summary))
    recorded_system(summary.files)
    restore([file for file in summary.files if len(file[2]) < 1 << 16], folder())
    whole = folder() / "whole.mcap"
    copied = repair(reader, whole, overwrite=True)
    if Summary(BagReader(whole)).messages != copied:
        raise AssertionError(f"{copied} messages were copied, and not found again")


_KEYS = ("rampart/localization/pose", "rampart/detection/DM1", "rampart/world/strange")


@target("recorded-json", refuses=(ValueError, RecursionError), form="json", samples=lambda: [
        b'{"source":"l","incarnation":1,"sequence":1,"stamp":1.0,"body":{"x_m":0.0,"y_m":0.0,'
        b'"yaw_rad":null}}', b'{"source":"","incarnation":0,"sequence":0,"stamp":null,'
        b'"raw":"wQ==","error":"x"}'])
def recorded_json(data: bytes) -> None:
    """A message of a recording that is played: JSON in, payload out."""
    refused = None
    for key in _KEYS:
        try:
            payload = Forms(topics.ALL).of(key).payload(data)
        except (ValueError, RecursionError) as error:
            refused = error
        else:
            header_of(payload)
    if refused is not None:
        raise refused


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
