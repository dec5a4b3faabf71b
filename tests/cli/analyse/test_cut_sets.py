"""`rampart cut-sets` as a user calls it."""

from __future__ import annotations

import json
from subprocess import CompletedProcess

import pytest

from rampart.cli.main import main
from tests import CELL


@pytest.fixture
def rampart(capsys):
    """Return what calls `rampart` in this process, for an interpreter takes a second to start."""
    def call(*arguments: str) -> CompletedProcess[str]:
        return CompletedProcess(arguments, main(list(arguments)), *capsys.readouterr())

    return call


def test_the_papers_system_is_listed_with_its_barriers(rampart):
    done = rampart("cut-sets", "paper")
    assert done.returncode == 0, done.stderr
    assert "7 minimal cut sets" in done.stdout
    assert "fewer than two barriers:\n  erroneous_graph: only FTM1" in done.stdout


def test_counts_are_json_for_scripts(rampart):
    done = rampart("cut-sets", "paper", "--count", "--json")
    assert json.loads(done.stdout) == {
        "format": 1, "top": "moving_inside_prohibited_area", "minimal_cut_sets": 7}


def test_what_is_exported_is_read_again(rampart, tmp_path):
    file = tmp_path / "cell.xml"
    assert rampart("cut-sets", str(CELL), "--export", str(file)).returncode == 0
    there, back = (json.loads(rampart("cut-sets", name, "--json").stdout)
                   for name in (str(CELL), str(file)))
    assert [s["events"] for s in there["sets"]] == [s["events"] for s in back["sets"]]
    assert there["by_size"] == back["by_size"]


def test_a_file_that_is_no_open_psa_is_one_line_and_exit_code_2(refused, tmp_path):
    file = tmp_path / "x.xml"
    file.write_text("<!DOCTYPE x [<!ENTITY a 'b'>]><opsa-mef>&a;</opsa-mef>")
    for more in ((), ("--export", "y.xml")):
        assert "without document type definitions and entities" in refused("cut-sets", file, *more)


def test_a_doubtful_file_is_analysed_with_a_warning(tmp_path, rampart):
    file = tmp_path / "plant.xml"
    file.write_text(
        '<opsa-mef><define-fault-tree name="t"><define-gate name="top"><and>\n'
        '<basic-event name="pump"/><basic-event name="pmup"/></and></define-gate>\n'
        '<define-basic-event name="pump"/></define-fault-tree></opsa-mef>')
    done = rampart("cut-sets", str(file), "--count", "--json")
    assert (done.returncode, json.loads(done.stdout)["minimal_cut_sets"]) == (0, 1)
    (line,) = done.stderr.splitlines()
    assert f"{file}:2: " in line
    assert "pmup" in line
