"""`rampart doctor`, and the help of `rampart`."""

import json
import tomllib

import pytest

from rampart.cli.look import doctor_verb
from rampart.cli.look.doctor_verb import Finding
from rampart.cli.main import build_parser, main
from tests import ROOT


def test_this_machine_can_run_and_each_thing_that_is_missing_has_its_cost(capsys):
    assert main(["doctor", "--json"]) == 0
    found = [Finding(**one) for one in json.loads(capsys.readouterr().out)]
    assert {"Python", "Linux", "memory", "open files", "Chromium", "ROS 2"} <= {
        one.what for one in found}
    assert all(bool(one.cost) == (one.state != "ok") for one in found)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert {f"extra {name}" for name in project["optional-dependencies"] if name != "dev"} <= {
        one.what for one in found}
    assert main(["doctor"]) == 0
    assert len(capsys.readouterr().out.splitlines()) == 1 + len(found)


@pytest.mark.parametrize(("load", "limit", "states"), [
    (0.3, 4096, ["ok", "ok"]), (11.7, 50, ["without", "missing"])])
def test_a_busy_machine_and_too_few_open_files_are_found_before_a_run(
        capsys, monkeypatch, load, limit, states):
    monkeypatch.setattr(doctor_verb.os, "sched_getaffinity", lambda _pid: {0, 1})
    monkeypatch.setattr(doctor_verb.os, "getloadavg", lambda: (load, 0.0, 0.0))
    monkeypatch.setattr(doctor_verb.resource, "getrlimit", lambda _which: (limit, limit))
    assert main(["doctor", "--json"]) == states.count("missing")
    assert [one["state"] for one in json.loads(capsys.readouterr().out)
            if one["what"] in {"processors", "open files"}] == states


def test_the_help_lists_every_verb_but_old_names_on_one_screen(capsys):
    assert main([]) == 0
    told = capsys.readouterr().out
    assert len(told.splitlines()) <= 40
    assert max(map(len, told.splitlines())) < 90
    verbs = build_parser().verbs
    listed = [action.dest for action in verbs._choices_actions]
    assert set(verbs.choices) - set(listed) == {"table", "trigger", "metrics", "incidents"}
    for verb in listed:
        assert f" {verb} " in told or f"{verb:<10}" in told
