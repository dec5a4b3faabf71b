"""A changed system that arrives as a message: what the supervisor and the spawners accept of it."""

from __future__ import annotations

import json
import sys
import tomllib

import pytest

from rampart.actors.ftm.messages import AdaptedSystem
from rampart.actors.runtime.run_context import RunContext
from rampart.actors.runtime.run_plan import RunPlan, load_system
from rampart.actors.system.layout import Layout, adapted_system
from tests import ROOT
from tests.two_hosts import two_hosts

FILE = ROOT / "systems" / "paper.toml"
PLAN = RunPlan("r", 20000, system_file=str(FILE))


LAYOUT = Layout(PLAN, load_system(PLAN))


@pytest.fixture
def document():
    return tomllib.loads(FILE.read_text())


def change(document, layout=LAYOUT) -> Layout:
    adapted = AdaptedSystem(1, "a change", "me", json.dumps(document))
    return adapted_system(layout, RunContext(), adapted)[0]


@pytest.mark.parametrize("table", ["node", "detection", "recovery"])
def test_a_module_that_was_not_there_at_the_start_is_never_imported(
        document, table, tmp_path, monkeypatch):
    document["strategy"] = "guarded-repair"
    assert change(document).spec.strategy == "guarded-repair"
    (tmp_path / "intruder.py").write_text("class Node: pass\n")
    monkeypatch.syspath_prepend(tmp_path)
    document[table][0]["actor"] = "intruder:Node"
    with pytest.raises(ValueError, match="expected a class in a module that the running"):
        change(document)
    assert "intruder" not in sys.modules


def left_out(document):
    document["node"] = [row for row in document["node"] if row["name"] != "teleoperation"]


@pytest.mark.parametrize(("edit", "words"), [
    (lambda document: document["detection"][0].update(process="another"), "DM1: process = 'anot"),
    (lambda document: document["detection"][0].update(process="DM2"), "DM1: process = 'DM2'"),
    (left_out, "teleoperation")])
def test_other_processes_than_those_that_run_are_refused(document, edit, words):
    edit(document)
    with pytest.raises(ValueError, match=words):
        change(document)


def test_a_host_to_which_a_module_would_have_to_move_is_refused(tmp_path):
    file = tmp_path / "two.toml"
    file.write_text(two_hosts({"robot": "10.0.0.1", "ground": "10.0.0.2"}))
    document = tomllib.loads(file.read_text())
    next(row for row in document["detection"] if row["name"] == "DM13")["host"] = "robot"
    plan = RunPlan(system_file=str(file))
    with pytest.raises(ValueError, match=r"^DM13: host = 'robot'"):
        change(document, Layout(plan, load_system(plan)))
