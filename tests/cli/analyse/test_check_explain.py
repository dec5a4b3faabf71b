"""`rampart check` and `rampart explain`: what is known of a system before it runs."""

from __future__ import annotations

import json

import pytest

from rampart.cli.main import main
from tests import CELL

TEXT = CELL.read_text(encoding="utf-8")


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
    "class": (('name = "camera"\nactor = "rampart.actors.runtime.stub_node:StubNode"',
               'name = "camera"\nactor = "rampart.actors.runtime.stub_node:StubNod"'),
              "node camera: actor = 'rampart.actors.runtime.stub_node:StubNod': no such actor "
              "class; known: StubNode"),
    "module": (('name = "camera"\nactor = "rampart.actors.runtime.stub_node:StubNode"',
                'name = "camera"\nactor = "no_such_module:Camera"'),
               "node camera: actor = 'no_such_module:Camera': No module named 'no_such_module'"),
    "application": (('title = "Pick and place behind a light curtain"',
                     'title = "x"\napplication = { class = "nothing:There" }'),
                    "$.application.class = 'nothing:There': No module named 'nothing'"),
    "option": (('title = "Pick and place behind a light curtain"',
                'title = "x"\napplication = { speed = 3 }'),
               "$.application: Object contains unknown field `speed`"),
}


@pytest.mark.parametrize("what", BROKEN)
@pytest.mark.parametrize("verb", ["check", "explain", "verify"])
def test_a_system_that_is_not_sound_is_one_line_and_exit_code_2(capsys, tmp_path, what, verb):
    (old, new), line = BROKEN[what]
    assert TEXT.count(old) == 1
    file = tmp_path / "cell.toml"
    file.write_text(TEXT.replace(old, new))
    out, err = said(capsys, verb, str(file), code=2)
    assert out == ""
    assert err.startswith(f"rampart: {file}: {line}")
    assert err.count("\n") == 1


def test_a_system_that_is_not_sound_for_scripts(capsys, tmp_path):
    (old, new), line = BROKEN["class"]
    file = tmp_path / "cell.toml"
    file.write_text(TEXT.replace(old, new))
    out, err = said(capsys, "check", str(file), "--json", code=2)
    assert json.loads(out) == {"format": 1, "sound": False, "problem": f"{file}: {line}"}
    assert err == ""


def test_what_a_system_is_for_scripts(capsys):
    found = json.loads(said(capsys, "explain", "paper", "--json")[0])
    assert found["format"] == 1
    assert {"topic": "control/command", "message": "Twist", "from": ["osmosis_control"],
            "to": ["safety_pilot", "DM2", "DM3"]} in found["talks"]
    assert {"topic": "control/standby_command", "message": "Twist", "from": [],
            "to": ["safety_pilot"]} in found["talks"]
    assert {"name": "safety_pilot", "kind": "pilot", "brought_back_by": "supervisor", "nodes": {
        "safety_pilot": "rampart.actors.osmosis.control.pilot.safety_pilot:SafetyPilot"},
        } in found["processes"]
    assert next(p for p in found["processes"] if p["kind"] == "world")["brought_back_by"] == ""
    names = {process["name"] for process in found["processes"]}
    assert {"root", "run", "supervisor", "pool", "router_a", "router_b"} < names
    assert {name for guard in found["guards"] for name in (guard["by"], *guard["of"])} <= names
    crash = next(each for each in found["consequences"] if each["detection"] == "DM4")
    assert (crash["mechanisms"], crash["active"], crash["decided"], crash["escalation"]) == (
        ["FTM4"], ["FTM4"], ["RM3"], {"RM3": ["RM2", "RM1"]})
