"""Airports and missions from files: ours, the paper authors', and broken ones."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from rampart.actors.osmosis.airport.formats import load_airport, load_mission, load_with_truth
from rampart.actors.osmosis.airport.graph_format import COLUMNS_PER_M, LEFT_M, ROWS_PER_M, TOP_M
from rampart.actors.osmosis.airport.model import AirportError

TOML = """
name = "Field"
edges = [["S", "T"]]
[start]
x_m = 0.0
y_m = 0.0
yaw_rad = 0.0
[nodes]
S = [0.0, 0.0]
T = [30.0, 0.0]
[[surface]]
name = "Runway"
kind = "runway"
centre_line = [[-3, 0], [33, 0]]
half_width_m = 3.0
[[row]]
name = "R"
nominal_cd = 200.0
first = [2.0, 0.0]
last = [10.0, 0.0]
count = 3
[missions.M]
goals = [{ x_m = 30.0, y_m = 0.0, mode = "light verification" }]
[[obstacle]]
name = "drum"
shape = "cylinder"
x_m = 15.0
y_m = 0.0
radius_m = 0.4
[world.light_factors]
R02 = 0.25
"""

GRAPH = {
    "nodes": [{"id": "N1", "x": 2, "y": 6}, {"id": "N2", "x": 10, "y": 6.0}],
    "edges": [["N1", "N2"]],
}


def write_toml(folder: Path, text: str) -> Path:
    path = folder / "field.toml"
    path.write_text(text)
    return path


def column(x_m: float) -> int:
    return round(COLUMNS_PER_M * (x_m - LEFT_M))


def row(y_m: float) -> int:
    return round(ROWS_PER_M * (TOP_M - y_m))


def red():
    """An image of the area from -80 to 80 m, all of it prohibited."""
    pixels = np.zeros((row(-80), column(80), 3), dtype=np.uint8)
    pixels[..., 0] = 255
    return pixels


def write_foreign(folder: Path, graph=None, mission="x=9.5,y=6,taxi=1\n\nx=3,y=6.25,taxi=0\n",
                  image="field_area.png"):  # fmt: skip
    """A red image with a green strip from y = 4 to 8 m, x = 1 to 11 m."""
    pixels = red()
    pixels[row(8):row(4), column(1):column(11)] = (0, 255, 0)
    pixels[row(10), column(6)] = (0, 255, 0)  # a speck on each ground
    pixels[row(6), column(6)] = (251, 255, 0)
    Image.fromarray(pixels).save(folder / image, quality=75)
    (folder / "field.graph").write_text(json.dumps(graph or GRAPH))
    (folder / "MISSION_A.miss").write_text(mission)
    return folder


def refusal(call, *args) -> str:
    with pytest.raises(AirportError) as caught:
        call(*args)
    line = str(caught.value)
    assert "\n" not in line
    return line


def test_our_own_format_gives_lights_missions_obstacles_and_pavement(tmp_path):
    airport, truth = load_with_truth(write_toml(tmp_path, TOML))
    assert truth.intensity_cd(airport) == {"R01": 200, "R02": 50, "R03": 200}
    assert [(light.name, light.x_m) for light in airport.lights] == [
        ("R01", 2.0), ("R02", 6.0), ("R03", 10.0)]  # fmt: skip
    assert airport.missions["M"].goals[0].mode == "light verification"
    assert airport.obstacles[0].name == "drum"
    assert airport.prohibited_distance_m(15, 1) == pytest.approx(2.0)
    assert airport.warnings == ()
    assert load_airport(airport.source).name == "Field"


@pytest.mark.parametrize(("old", "new", "expected"), [
    ("T = [30.0, 0.0]", "T = [nan, 0.0]", "nodes.T[0]: nan: must be a finite number"),
    ("T = [30.0, 0.0]", "T = [30.0, 20.0]", "in the prohibited area; expected on the pavement"),
    ("T = [30.0, 0.0]", "S = [30.0, 0.0]", "file: not valid TOML: "),
    ("half_width_m = 3.0", "half_width_m = -3.0", "half_width_m: -3.0: expected a number > 0"),
    ("radius_m = 0.4", "radius_m = 9.0", "obstacle[0].radius_m: 9.0: "),
    ("half_width_m = 3.0", "", "surface[0].half_width_m: None: missing beside centre_line"),
    ("half_width_m = 3.0", "half_widht_m = 3.0", "surface[0].half_widht_m: 3.0: unknown field"),
    ("centre_line = [[-3, 0], [33, 0]]", "polygon = [[0,0],[9,9],[9,0],[0,9]]",
     "surface[0].polygon: Self-intersection"),
    ("centre_line = [[-3, 0], [33, 0]]", "", "expected either polygon or centre_line"),
    ("count = 3", "", "row[0]: R: expected either first, last and count, or positions"),
    ('name = "Field"', "", "file: required field 'name' is missing"),
    ("R02 = 0.25", "R09 = 0.25", "world.light_factors.R09: 'R09': unknown light"),
    ("[[surface]]", '[[surface]]\nname = "Runway"\nkind = "apron"\n'
     "polygon = [[0,0],[1,0],[0,1]]\n[[surface]]", "surface: 'Runway': duplicate name")])
def test_a_broken_airport_is_refused_in_one_line_with_file_field_and_value(
        tmp_path, old, new, expected):
    assert old in TOML
    path = write_toml(tmp_path, TOML.replace(old, new, 1))
    line = refusal(load_airport, path)
    assert line.startswith(f"{path}: ")
    assert expected in line


@pytest.mark.parametrize("image", ["field_area.png", "field_area.jpg"])
def test_the_authors_formats_load_as_an_airport_of_ones_own(tmp_path, image):
    airport = load_airport(write_foreign(tmp_path, image=image))
    assert airport.nodes == {"N1": (2.0, 6.0), "N2": (10.0, 6.0)}
    goals = airport.missions["A"].goals
    assert [(g.x_m, g.y_m, g.mode) for g in goals] == [
        (9.5, 6.0, "taxi"), (3.0, 6.25, "light verification")]  # fmt: skip
    assert (airport.start.x_m, airport.start.y_m, airport.start.yaw_rad) == (2.0, 6.0, 0.0)
    # The strip is 40 m2, its edge of 28 m is right to about a pixel; specks of one pixel are gone.
    assert airport.allowed.geom_type in ("Polygon", "MultiPolygon")
    assert airport.allowed.area == pytest.approx(40, abs=28 / ROWS_PER_M)
    assert airport.prohibited_distance_m(6, 6) == pytest.approx(2.0, abs=1.5 / ROWS_PER_M)
    assert airport.prohibited_distance_m(6, 10) < 0
    assert airport.prohibited_distance_m(-5, 6) < 0
    assert airport.warnings == ("field.graph: lights: none: there is nothing to inspect",)


def test_jpeg_ringing_beside_an_edge_does_not_widen_the_pavement(tmp_path):
    pixels = red()
    for line in range(len(pixels)):  # a slanted edge crosses blocks everywhere
        pixels[line, 300 + line // 3 : 360 + line // 3] = (0, 255, 0)
    Image.fromarray(pixels).save(tmp_path / "field_area.jpg", quality=60)
    (tmp_path / "field.graph").write_text(
        json.dumps({"nodes": [{"id": "N", "x": -10, "y": 58}], "edges": []}))  # fmt: skip
    airport = load_airport(tmp_path)
    strip_m2 = 60 * len(pixels) / (COLUMNS_PER_M * ROWS_PER_M)
    assert airport.allowed.area == pytest.approx(strip_m2, rel=0.03)


def test_a_node_in_the_red_of_a_foreign_airport_is_a_warning_not_a_refusal(tmp_path):
    graph = {"nodes": [*GRAPH["nodes"], {"id": "N3", "x": 10, "y": 10}],
             "edges": [["N1", "N2"], ["N2", "N3"]]}  # fmt: skip
    airport = load_airport(write_foreign(tmp_path, graph))
    assert any("nodes.N3: (10, 10): in the prohibited area" in w for w in airport.warnings)


@pytest.mark.parametrize(("file", "content", "expected"), [
    *(("field.graph", json.dumps(graph), expected) for graph, expected in [
        ({"nodes": [{"id": "N1", "x": 1}], "edges": []}, "missing required field `y` - at `$.nod"),
        ({"nodes": [{"id": "N1", "x": 1, "y": 1e9}], "edges": []}, "<= 1000000.0 - at `$.nodes[0]"),
        ({"nodes": [GRAPH["nodes"][0]] * 2, "edges": []}, "nodes: 'N1': duplicate id"),
        ({"nodes": GRAPH["nodes"], "edges": [["N1", "N9"]]}, "edges[0]: 'N9': unknown node")]),
    *(("MISSION_B.miss", text, expected) for text, expected in [
        ("x=1,y=2", "line 1: 'x=1,y=2': expected x=20,y=-57,taxi=1"),
        ("\nx=1,y=2,taxi=2", "line 2: taxi=2: expected 1 (taxi) or 0"),
        ("x=1,y=abc,taxi=1", "line 1: y: 'abc': must be a finite number of metres"),
        ("\n \n", "goals: empty"),
        ("x=50,y=6,taxi=1", "40.0 m from the graph")]),
    ("field.graph", None, "expected exactly one .toml or .graph"),
    ("field.graph", "{", "expected a graph"),
    ("field_area.png", None, "area image: none: expected exactly one"),
    ("field_area.png", "no", "area image: unreadable"),
    ("field_area.png", red(), "area image: entirely red")])
def test_a_broken_file_of_the_authors_is_refused_in_one_line(tmp_path, file, content, expected):
    path = write_foreign(tmp_path) / file
    if content is None:
        path.unlink()
    elif isinstance(content, str):
        path.write_text(content)
    else:
        Image.fromarray(content).save(path)
    assert expected in refusal(load_airport, tmp_path)


def test_missions_load_by_name_and_from_both_kinds_of_file(tmp_path):
    airport = load_airport(write_foreign(tmp_path))
    assert load_mission("A", airport) is airport.missions["A"]
    assert load_mission(tmp_path / "MISSION_A.miss", airport) == airport.missions["A"]
    own = tmp_path / "own.toml"
    own.write_text('name = "O"\ngoals = [{ x_m = 4, y_m = 6, mode = "taxi" }]')
    assert load_mission(own, airport).name == "O"
    assert "unknown mission; known: A" in refusal(load_mission, "B", airport)
    own.write_text('name = "O"\ngoals = [{ x_m = 50, y_m = 6, mode = "taxi" }]')
    assert "40.0 m from the graph" in refusal(load_mission, own, airport)


def test_a_name_that_no_file_can_have_is_refused_like_one_that_is_not_there():
    name = "a" * 300
    for long in (name, f"{name}.toml"):
        assert "cannot be read: File name too long" in refusal(load_airport, long)
    assert "did you mean 'vallombre'?" in refusal(load_airport, "valombre")
    assert "file: missing" in refusal(load_airport, "no/such.toml")
    airport = load_airport("vallombre")
    assert name[:200] in refusal(load_mission, f"{name}.miss", airport)
