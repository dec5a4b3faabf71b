"""Targets: files that users give to the program."""

from __future__ import annotations

import io
import json
import tempfile
from functools import cache
from pathlib import Path

import msgspec
from mcap.writer import CompressionType, Writer
from PIL import Image

from rampart.actors.osmosis import topics
from rampart.actors.osmosis.airport.formats import load_airport
from rampart.actors.osmosis.airport.model import AirportError
from rampart.actors.recording.bag_reader import BagReader, Summary, repair
from rampart.actors.recording.bag_writer import BagError
from rampart.actors.recording.message_form import Forms, header_of
from rampart.actors.recording.run_documents import recorded_system, restore
from rampart.cli.record.record_verbs import described
from rampart.files import toml
from rampart.files.reading import FileError
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

