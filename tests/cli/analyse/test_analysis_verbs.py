"""`rampart check`, `explain`, `cut-sets` and `tree`: what is known of a system before it runs."""

from __future__ import annotations

import itertools
import json
import re
import subprocess
import xml.etree.ElementTree as ET
from io import BytesIO, TextIOWrapper

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rampart.cli import systems
from rampart.cli.analyse.tree_verbs import to_text
from rampart.cli.main import main
from rampart.files.plain_text import one_line
from rampart.manager.drawing.diagram import Box, Diagram, covers
from rampart.manager.drawing.placing import place
from rampart.manager.model.order import PartialOrder
from rampart.systems import SHIPPED
from tests import CELL

TEXT = CELL.read_text(encoding="utf-8")
CAMERA = 'name = "camera"\nactor = "rampart.actors.runtime.stub_node:StubNode"'


@pytest.fixture(autouse=True)
def _the_papers_system(monkeypatch):
    """Its decisions are known by heart; the full system's are judged elsewhere."""
    monkeypatch.setattr(systems, "DEFAULT", SHIPPED / "paper.toml")


def said(capsys, *arguments: str, code: int = 0) -> tuple[str, str]:
    assert main(arguments) == code
    return tuple(capsys.readouterr())


def test_a_sound_system_for_scripts(capsys):
    found = json.loads(said(capsys, "check", str(CELL), "--json")[0])
    assert found == {
        "format": 1, "sound": True, "problem": None, "system": "cell",
        "file": str(CELL), "processes": 22, "nodes": 9, "detection_modules": 8,
        "recovery_modules": 6, "mechanisms": 6}


BROKEN = {
    "syntax": (("[orders.safer]", "[orders.safer"), "$: "),
    "class": ((CAMERA, CAMERA.replace("StubNode", "StubNod")),
              "node camera: actor = 'rampart.actors.runtime.stub_node:StubNod': no such actor "
              "class; known: StubNode"),
    "module": ((CAMERA, 'name = "camera"\nactor = "no_such_module:Camera"'),
               "node camera: actor = 'no_such_module:Camera': No module named 'no_such_module'"),
    "application": (('title = "Pick and place behind a light curtain"',
                     'title = "x"\napplication = { class = "nothing:There" }'),
                    "$.application.class = 'nothing:There': No module named 'nothing'"),
    "option": (('title = "Pick and place behind a light curtain"',
                'title = "x"\napplication = { speed = 3 }'),
               "$.application: Object contains unknown field `speed`"),
}


@pytest.mark.parametrize(("change", "line"), BROKEN.values(), ids=BROKEN)
def test_a_system_that_is_not_sound_is_one_line_and_exit_code_2(
        refused, capsys, tmp_path, change, line):
    assert TEXT.count(change[0]) == 1
    file = tmp_path / "cell.toml"
    file.write_text(TEXT.replace(*change))
    for verb in ("check", "explain", "verify") if line.startswith("$: ") else ("check",):
        assert refused(verb, file).startswith(f"rampart: {file}: {line}")
    out, err = said(capsys, "check", str(file), "--json", code=2)
    found = json.loads(out)
    assert (found["format"], found["sound"], err) == (1, False, "")
    assert found["problem"].startswith(f"{file}: {line}")


@pytest.mark.parametrize("options", [(), ("--json",)])
def test_a_command_that_this_machine_lacks_is_a_warning(capsys, tmp_path, options):
    file = tmp_path / "cell.toml"
    file.write_text(TEXT.replace(*("""actor = "rampart.actors.runtime.stub_node:StubNode"
""", """command = ["no-such-program"]
"""), 2))
    out, err = said(capsys, "check", str(file), *options)
    assert "sound" in out
    assert len(lines := err.splitlines()) == 2
    assert lines[0].startswith(f"rampart: {file}: ")
    assert all("'no-such-program' in PATH; one in the folder is './no-such-program'; a run on this "
               "machine is refused" in line for line in lines)


def test_what_a_system_is_for_scripts(capsys):
    found = json.loads(said(capsys, "explain", "paper", "--json")[0])
    assert found["format"] == 1
    crash = next(each for each in found["consequences"] if each["detection"] == "DM4")
    assert (crash["mechanisms"], crash["active"], crash["decided"], crash["escalation"]) == (
        ["FTM4"], ["FTM4"], ["RM3"], {"RM3": ["RM2", "RM1"]})


def with_command(name: str, timeout_s: float) -> str:
    """The cell with a command in place of a node, with a timeout of its own heartbeat."""
    actor = CAMERA.replace("camera", name)
    assert TEXT.count(actor) == 1
    return TEXT.replace(actor, f'name = "{name}"\ncommand = ["sleep", "1000"]\n'
                               f'heartbeat = {{ key = "alive", timeout_s = {timeout_s} }}')


def test_a_hang_of_a_command_is_detected_after_the_timeout_of_its_own_heartbeat(capsys, tmp_path):
    file = tmp_path / "cell.toml"
    file.write_text(with_command("camera", 0.42))
    found = json.loads(said(capsys, "explain", str(file), "--json")[0])
    within_s = {each["detection"]: each["within_s"] for each in found["consequences"]}
    assert (within_s["D_VISION_CRASH"], within_s["D_MOTION_CRASH"]) == (0.42, 0.3)
    assert "D_VISION_CRASH" in said(capsys, "explain", str(file))[0]
    file.write_text(with_command("motion_planner", 1.0))
    _, err = said(capsys, "check", str(file), code=2)
    assert "the time budget does not fit: M_MOTION" in err


def test_the_papers_system_is_listed_with_its_barriers(capsys):
    listed, _ = said(capsys, "cut-sets", "paper")
    assert "7 minimal cut sets" in listed
    assert "fewer than two barriers:\n  erroneous_graph: only FTM1" in listed


def test_counts_are_json_for_scripts(capsys):
    out, _ = said(capsys, "cut-sets", "paper", "--count", "--json")
    assert json.loads(out) == {
        "format": 1, "top": "moving_inside_prohibited_area", "minimal_cut_sets": 7}


def test_what_is_exported_is_read_again(capsys, tmp_path):
    file = tmp_path / "cell.xml"
    said(capsys, "cut-sets", str(CELL), "--export", str(file))
    there, back = (json.loads(said(capsys, "cut-sets", name, "--json")[0])
                   for name in (str(CELL), str(file)))
    assert [s["events"] for s in there["sets"]] == [s["events"] for s in back["sets"]]
    assert there["by_size"] == back["by_size"]


def test_a_file_that_is_no_open_psa_is_one_line_and_exit_code_2(refused, tmp_path):
    file = tmp_path / "x.xml"
    file.write_text("<!DOCTYPE x [<!ENTITY a 'b'>]><opsa-mef>&a;</opsa-mef>")
    for more in ((), ("--export", "y.xml")):
        assert "without document type definitions and entities" in refused("cut-sets", file, *more)


def test_a_doubtful_file_is_analysed_with_a_warning(capsys, tmp_path):
    file = tmp_path / "plant.xml"
    file.write_text(
        '<opsa-mef><define-fault-tree name="t"><define-gate name="top"><and>\n'
        '<basic-event name="pump"/><basic-event name="pmup"/></and></define-gate>\n'
        '<define-basic-event name="pump"/></define-fault-tree></opsa-mef>')
    out, err = said(capsys, "cut-sets", str(file), "--count", "--json")
    assert json.loads(out)["minimal_cut_sets"] == 1
    (line,) = err.splitlines()
    assert f"{file}:2: " in line
    assert "pmup" in line


def graph(edges, **boxes) -> Diagram:
    """Return a fault tree; the gates follow from the edges."""
    names = list(dict.fromkeys([*itertools.chain.from_iterable(edges), *boxes]))
    inputs = {name: sum(upper == name for upper, _ in edges) for name in names}
    return Diagram("fault-tree", "T", tuple(
        boxes.get(name) or Box(name, gate="or" if inputs[name] else "", inputs=inputs[name],
                               required=min(1, inputs[name])) for name in names), tuple(edges))


@st.composite
def fault_trees(draw_from):
    """A random graph under one top, with shared events, all kinds of gates, and barriers."""
    count = draw_from(st.integers(1, 14))
    uppers = [draw_from(st.sets(st.integers(0, i - 1), min_size=1, max_size=3))
              for i in range(1, count)]
    edges = [(f"e{u}", f"e{i}") for i, us in enumerate(uppers, 1) for u in sorted(us)]
    boxes = []
    for i in range(count):
        name = f"e{i}"
        inputs = sum(upper == name for upper, _ in edges)
        required = draw_from(st.integers(1, inputs)) if inputs else 0
        gate = "" if not inputs else draw_from(st.sampled_from(["or", "and", "at-least"]))
        mechanism = f"F{i}" if draw_from(st.booleans()) else ""
        title = one_line(draw_from(st.text(max_size=40)))
        boxes.append(Box(name, title, gate, required, inputs, mechanism, f"D{i}", f"R{i}"))
    return Diagram("fault-tree", "T", tuple(boxes), tuple(edges))


def assert_apart(boxes) -> None:
    for (x, y, w, h), (x2, y2, w2, h2) in itertools.combinations(boxes, 2):
        assert x + w <= x2 or x2 + w2 <= x or y + h <= y2 or y2 + h2 <= y


@given(fault_trees())
def test_every_box_of_any_graph_is_drawn_once_with_gate_and_barrier(diagram):
    for box in diagram.boxes:
        (line,) = [line for line in to_text([diagram]).splitlines()
                   if re.search(rf"(^|[‖─] ){box.name}( |$)(?!↑)", line)]
        assert not box.gate or f"{box.name} [{box.gate_words}]" in line
        assert box.barrier_words in line


@given(fault_trees(), st.booleans())
def test_boxes_stay_apart_and_lines_go_from_box_to_box_and_cross_none(diagram, square):
    sizes = {box.name: (40.0 + 7 * len(box.title), 50.0) for box in diagram.boxes}
    placing = place(sizes, diagram.edges, square=square)
    places = placing.places
    assert_apart([(p.left, p.top, p.width, p.height) for p in places.values()])
    for (upper, lower), line in zip(diagram.edges, placing.lines, strict=True):
        assert line[0] == (pytest.approx(places[upper].x, abs=0.01), places[upper].bottom)
        assert line[-1][1] == places[lower].top
        assert places[lower].left <= line[-1][0] <= places[lower].left + places[lower].width
        assert [y for _, y in line] == sorted(y for _, y in line)
        for (x, y), (x2, y2) in itertools.pairwise(line):
            for box in places.values():
                high, low = max(y, box.top + 0.1), min(y2, box.bottom - 0.1)
                for inside in (high, low) if high < low else ():
                    at = x + (x2 - x) * (inside - y) / (y2 - y)
                    assert not box.left < at < box.left + box.width
    for place_ in places.values():
        assert -0.01 <= place_.left <= placing.width + 0.01 - place_.width


def test_a_shared_event_is_drawn_once_and_referred_to():
    shared = graph([("t", "a"), ("t", "b"), ("a", "s"), ("b", "s"), ("s", "x"), ("s", "y")])
    assert to_text([shared]).splitlines()[1:] == [
        "t [or]", "├── a [or]", "│   └── s [or]", "│       ├── x", "│       └── y",
        "└── b [or]", "    └── s ↑"]


@settings(deadline=None)
@given(st.integers(1, 9).flatmap(lambda n: st.sets(
    st.tuples(st.integers(0, n - 1), st.integers(0, n - 1)).filter(lambda p: p[0] < p[1]))))
def test_the_hasse_diagram_holds_neighbours_only_and_says_as_much_as_the_order(pairs):
    names = [f"R{i}" for i in range(9)]
    above = {}
    for upper, lower in pairs:
        above.setdefault(names[upper], []).append(names[lower])
    order = PartialOrder(names, above)
    expected = {(a, b) for a in names for b in names if order.is_above(a, b) and not any(
        order.is_above(a, c) and order.is_above(c, b) for c in names)}
    found = covers(order)
    assert set(found) == expected
    assert len(found) == len(expected)


HOSTILE = '</text><script>alert("1")</script> & "quoted" \\N \\" \x1b[31m \u202e \x00 ]]> -->\n|{}'


def test_hostile_titles_are_shown_and_obeyed_by_nobody(capsys, tmp_path):
    text = systems.DEFAULT.read_text(encoding="utf-8")
    for word in ("Erroneous graph", "Emergency stop", "Runway light inspection with a Summit XL",
                 "safer"):
        text = text.replace(f'"{word}"', json.dumps(HOSTILE))
    file = tmp_path / "hostile.toml"
    file.write_text(text.replace("[orders.safer]", f"[orders.{json.dumps(HOSTILE)}]"))
    tree = ["tree", "--system", str(file)]
    shown = [said(capsys, *tree, *more)[0] for more in ((), ("--json",), ("--dot",))]
    assert not {"\x1b", "\x00", "\u202e"} & set("".join(shown))
    assert f"├── erroneous_graph  {one_line(HOSTILE)}" in shown[0].splitlines()
    assert len(json.loads(shown[1])) == 3
    drawn = ET.fromstring(subprocess.run(
        ("dot", "-Tsvg"), input=shown[2], capture_output=True, text=True, check=True).stdout)
    assert not drawn.findall(".//{*}script")
    assert one_line(HOSTILE) in {text.text for text in drawn.findall(".//{*}text")}
    boxes = {box["name"] for diagram in json.loads(shown[1]) for box in diagram["boxes"]}
    assert len(drawn.findall(".//{*}g[@class='node']")) >= len(boxes)


CHAIN = [(f"e{i}", f"e{i + 1}") for i in range(999)]


@pytest.mark.parametrize("edges", [
    CHAIN, [("e0", f"e{i}") for i in range(1, 1000)],
    [*CHAIN[:600], *(("e0", f"e{i}") for i in range(2, 600))],
], ids=["chain", "flat", "long lines"])
def test_a_thousand_events_are_drawn_and_placed(edges):
    diagram = graph(edges)
    placing = place({box.name: (90.0, 30.0) for box in diagram.boxes}, edges, square=True)
    assert len(placing.places) == len(diagram.boxes)
    assert_apart([(p.left, p.top, p.width, p.height) for p in placing.places.values()])
    assert to_text([diagram]).count("\n") == 1 + len(edges) + 1


def test_a_terminal_without_these_characters_is_told_so(capsys, monkeypatch):
    monkeypatch.setattr("sys.stdout", TextIOWrapper(BytesIO(), encoding="ascii"))
    assert main(["tree"]) == 2
    assert "ascii" in capsys.readouterr().err


def test_the_json_is_the_diagram(capsys):
    diagrams = msgspec.json.decode(said(capsys, "tree", "--json")[0], type=list[Diagram])
    spec = systems.load(None)
    assert [(d.what, {box.name for box in d.boxes}) for d in diagrams] == [
        (what, {one.name for one in of}) for what, of in (
            ("fault-tree", spec.events), ("ftm-tree", spec.mechanisms),
            ("order", spec.recoveries))]
    assert {box.mechanism for box in diagrams[0].boxes} > {m.name for m in spec.mechanisms}
    assert ("RM1", "RM2") in diagrams[2].edges
