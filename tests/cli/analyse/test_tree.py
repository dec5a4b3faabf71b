"""`rampart tree`: it shows everything, escapes everything, and survives large trees."""

from __future__ import annotations

import itertools
import json
import re
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


@pytest.fixture(autouse=True)
def _the_papers_system(monkeypatch):
    """Its decisions are known by heart; the full system's are judged elsewhere."""
    monkeypatch.setattr(systems, "DEFAULT", SHIPPED / "paper.toml")


def told(capsys) -> str:
    return capsys.readouterr().out


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
    shown = []
    for more in ((), ("--json",)):
        assert main(["tree", "--system", str(file), *more]) == 0
        shown.append(told(capsys))
        assert not {"\x1b", "\x00", "\u202e"} & set(shown[-1])
    assert f"├── erroneous_graph  {one_line(HOSTILE)}" in shown[0].splitlines()
    assert len(json.loads(shown[1])) == 3


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
    main(["tree", "--json"])
    diagrams = msgspec.json.decode(told(capsys), type=list[Diagram])
    spec = systems.load(None)
    assert [(d.what, {box.name for box in d.boxes}) for d in diagrams] == [
        (what, {one.name for one in of}) for what, of in (
            ("fault-tree", spec.events), ("ftm-tree", spec.mechanisms),
            ("order", spec.recoveries))]
    assert {box.mechanism for box in diagrams[0].boxes} > {m.name for m in spec.mechanisms}
    assert ("RM1", "RM2") in diagrams[2].edges
