"""`rampart check`, `explain` and `cut-sets`: what is known of a system before it runs."""

from __future__ import annotations

import json

import pytest

from rampart.cli.main import main
from tests import CELL

TEXT = CELL.read_text(encoding="utf-8")
CAMERA = 'name = "camera"\nactor = "rampart.actors.runtime.stub_node:StubNode"'


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
