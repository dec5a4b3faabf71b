"""Panels that a specification or a page's class declares: checked at load, heard, and bounded."""

from __future__ import annotations

import dataclasses
import json
import math
import re
from pathlib import Path

import msgspec
import pytest

from rampart.actors.operator.hmi import Hmi
from rampart.actors.operator.panels import MAX_KEPT, MAX_PANELS, Panel
from rampart.actors.operator.server import page_files
from rampart.actors.operator.state import HmiState
from rampart.actors.osmosis.page.hmi import OsmosisHmi
from rampart.actors.runtime.actor import Actor
from rampart.actors.runtime.run_plan import RunPlan
from rampart.actors.system.layout import Layout
from rampart.manager.spec.specification import parse_specification
from rampart.testing import eventually
from tests import ROOT, TANK
from tests.actors.operator.world import Others
from tests.tank import GAUGE, LEVEL, PUMP, TOPICS, VALVE, Level, Phase, Pump

WORKS = """
[[node]]
name = "pump"
actor = "tests.actors.operator.test_panels:Works"
kind = "control"
"""
PAGE = """
[[node]]
name = "page"
actor = "rampart.actors.operator.hmi:Hmi"
kind = "non-control"
"""


class Works(Actor):
    """Publishes what there is to show."""

    outputs = (LEVEL, PUMP, VALVE, GAUGE)


class Speaks(Others):
    """Says what the tests want."""

    outputs = (*Others.outputs, LEVEL, PUMP, VALVE)


class OwnHmi(Hmi):
    """A page with a panel of its class."""

    panels = (Panel(title="Own", gauge="tank/level:height_m", max=3.0),)


def layout(panels: str = "", page: str = PAGE) -> Layout:
    return Layout(RunPlan(system_file="tank.toml"),
                  parse_specification(TANK + WORKS + page + panels, "tank.toml"))


def shown(found: Layout) -> list[tuple[str, str]]:
    return [(p.title, p.kind) for p in found.members["page"].parameters.panels]


def panel(title: str, rest: str) -> str:
    return f'[[panel]]\ntitle = "{title}"\n{rest}\n'


# ---- at load ------------------------------------------------------------------------------------


def test_the_page_hears_what_the_panels_of_class_and_specification_show():
    found = layout(panel("Pump", 'states = "tank/pump:phase"\nof = ["idle", "filling"]'),
                   PAGE.replace("rampart.actors.operator.hmi:Hmi", f"{__name__}:OwnHmi"))
    assert shown(found) == [("Own", "gauge"), ("Pump", "states")]
    assert found.topics == {"tank/level": LEVEL, "tank/pump": PUMP}
    assert found.members["page"].hears.keys() == {"tank/level", "tank/pump"}


def test_a_page_without_panels_plots_the_numbers_of_what_comes_regularly():
    found = layout()
    plots = found.members["page"].parameters.panels
    assert [(p.title, p.plot) for p in plots] == [
        ("tank/level m", ("tank/level:height_m",)),
        ("tank/level rad", ("tank/level:heading_rad",)),
        ("tank/pump s", ("tank/pump:busy_until_s",)), ("tank/valve", ("tank/valve:opening",))]


def test_the_examples_of_the_document_are_sound(tmp_path):
    document = (ROOT / "docs/how-to/operator-page.md").read_text("utf-8")
    toml, python = (re.findall(rf"```{kind}\n(.*?)```", document, re.DOTALL)[0]
                    for kind in ("toml", "python"))
    assert shown(layout(toml)) == [
        ("Level", "gauge"), ("Level over time", "plot"), ("Pump", "states")]
    assert [line for line in [str(caught(toml.replace("phase", "phse")))] if line in document]
    (tmp_path / "page").mkdir()
    (tmp_path / "page" / "pipes.js").write_text("export default class {}")
    made: dict = {"__file__": str(tmp_path / "tank.py"), "__name__": "tank"}
    exec(python, made)
    assert [p.kind for p in made["TankPage"].panels] == ["gauge", "script"]
    assert "/robot/pipes.js" in page_files(made["TankPage"].files)


def caught(panels: str) -> ValueError:
    with pytest.raises(ValueError, match=r".") as found:
        layout(panels)
    return found.value


MANY = "".join(panel(f"P{i}", 'text = "tank/level:height_m"') for i in range(MAX_PANELS + 1))
PLOTS = "".join(panel(f"P{i}", f'plot = {["tank/level:height_m"] * 8}') for i in range(5))


@pytest.mark.parametrize(("panels", "words"), [
    ('gauge = "tank/levle:height_m"', "no actor has a topic 'tank/levle'; the nearest: tank/level"),
    ('plot = ["tank/level:height_m", "tank/level:hieght_m"]', "did you mean height_m?"),
    ('gauge = "tank/pump:phase"', "topic tank/pump: phase is a text; expected a number"),
    ('states = "tank/level:height_m"', "height_m is a number; expected a text or a truth"),
    ('script = "map.js"', ".script = 'map.js': 'Level': only the class of a page has scripts"),
    ('gauge = "a:b"\ntext = "a:b"', "'Level' has gauge and text; expected one of "),
    ('gauge = "a:b"\nseconds = 3', "seconds does not apply to a gauge; it takes max, min, unit"),
    ('gauge = "a:b"\nmin = 2', "'Level': min = 2 is not below max = 1"),
    ('map = ["a:x", "a:y"]\nextent_m = [0, 0, 0, 1]', "'Level': extent_m: expected x0, y0"),
    (panel("Level", 'gauge = "tank/level:height_m"') * 2, "two panels have this title"),
    (PLOTS, f"40 fields in plots and maps; expected at most {MAX_KEPT} together"),
    (MANY, f"$.panel: {MAX_PANELS + 1} panels; expected at most {MAX_PANELS}"),
])
def test_a_panel_that_cannot_be_is_refused_in_one_line(panels, words):
    said = str(caught(panels if "[[panel]]" in panels else panel("Level", panels)))
    assert said.startswith("tank.toml: ")
    assert words in said
    assert "\n" not in said


def test_panels_that_no_node_shows_are_refused():
    with pytest.raises(ValueError, match=r"^tank.toml: \$.panel: no node takes it; "
                                         r"expected a node with actor = 'rampart\.\S+:Hmi'\Z"):
        layout(panel("Level", 'gauge = "tank/level:height_m"'), "")


def test_a_script_that_is_not_there_is_noticed_when_the_class_is_made():
    with pytest.raises(ValueError, match=r"panel 'Map': script = 'nothing.js': expected a file in "
                                         r"Wrong.files = '.*files'"):
        type("Wrong", (Hmi,), {"files": OsmosisHmi.files,
                               "panels": (Panel(title="Map", script="nothing.js"),)})


# ---- what is heard ------------------------------------------------------------------------------


PANELS = (Panel(title="Level", gauge="tank/level:height_m"),
          Panel(title="Over time", plot=("tank/level:height_m", "tank/pump:running"), seconds=600),
          Panel(title="Pump", states="tank/pump:phase"),
          Panel(title="All", table=("tank/level:cells[max]", "tank/valve:shut")),
          Panel(title="Rule", text="manager/status:strategy"))


def hmi(world, panels=PANELS, kind: type[Hmi] = Hmi) -> Hmi:
    from rampart.actors.ftm import topics

    known = {t.key: t for t in (*TOPICS, *topics.ALL)}
    return kind(dataclasses.replace(
        world.context("hmi", 1), topics=known,
        parameters={"panels": panels}))


async def test_the_latest_value_of_each_field_is_shown_and_what_was_plotted_lately(world):
    world.others = Speaks(world.context("speaks", 1))
    async with world.running(world.others), world.running(hmi(world)) as page:
        picture = page._state.picture
        for height in (0.1, 0.2, 0.3):
            world.others.publish(LEVEL, Level(height, (1.0, height)))
            await eventually(lambda h=height: (v := picture.value("tank/level:height_m"))
                             is not None and v.value == h)
        world.others.publish(PUMP, Pump(Phase.FILLING))
        world.say_latched("RM1")
        await eventually(lambda: picture.value("tank/pump:phase") is not None
                         and picture.value("manager/status:strategy") is not None)
        assert page._state.latched == ("RM1",)  # the page's own handler hears it too
        now = json.loads(msgspec.json.encode(picture.changes(0)))
        assert now["tank/level:cells[max]"] == {"value": 1.0, "stale": False, "t": 0.0}
        assert now["tank/valve:shut"] is None
        assert (now["tank/level:height_m"]["value"], now["tank/pump:phase"]["value"],
                now["manager/status:strategy"]["value"]) == (0.3, "filling", "safety-first")
        past = page._hello()["past"]
        assert past["tank/level:height_m"][0][1] == 0.1
        assert past.keys() == {"tank/level:height_m", "tank/pump:running"}


async def test_a_field_that_is_not_known_is_said_and_the_rest_is_shown(world):
    strange = (Panel(title="Strange", text="no/topic:x"), *PANELS)
    async with world.running(hmi(world, strange)) as page:
        await eventually(lambda: any(d.context == "panel" for d in world.others.diagnostics))
        assert "hmi: unknown topic 'no/topic'" in {d.reason for d in world.others.diagnostics}
        assert page._hello()["panels"][0]["title"] == "Strange"


def test_a_field_is_stale_by_the_rate_of_its_topic():
    state = HmiState()
    state.show_field("slow:x", 0.0, 30.0)
    state.show_field("event:x", 0.0, math.inf)
    for name in ("slow:x", "event:x"):
        state.field(name, "a text", 0.0, 0.0)
    state.grow_old(29.0)
    assert not state.picture.value("slow:x").stale
    state.grow_old(1e6)
    assert state.picture.value("slow:x").stale
    assert not state.picture.value("event:x").stale


# ---- what is served -----------------------------------------------------------------------------


def test_a_robot_s_files_are_served_beside_the_page_s_which_know_no_robot():
    plain, own = page_files(None), page_files(OsmosisHmi.files)
    assert own.keys() - plain.keys() == {
        f"/robot/{file.name}" for file in Path(OsmosisHmi.files).iterdir()}
    head = own["/"].content.decode()
    for link in ('<link rel="stylesheet" href="robot/osmosis.css">',
                 '<link rel="modulepreload" href="robot/map.js">',
                 '<link rel="modulepreload" href="app.js">'):
        assert link in head
    words = ("airport", "lights", "mission", "runway", "osmosis")
    for path, file in plain.items():
        text = file.content.decode().lower()
        assert [word for word in words if word in text] == [], path
