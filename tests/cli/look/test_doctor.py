"""`rampart doctor`, and the help of `rampart`."""

from __future__ import annotations

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
    assert main(["doctor"]) == 0
    assert len(capsys.readouterr().out.splitlines()) == 1 + len(found)


@pytest.mark.parametrize(("load", "state"), [(0.3, "ok"), (11.7, "without")])
def test_a_machine_that_is_busy_is_named_with_what_it_costs(capsys, monkeypatch, load, state):
    monkeypatch.setattr(doctor_verb.os, "sched_getaffinity", lambda _pid: {0, 1})
    monkeypatch.setattr(doctor_verb.os, "getloadavg", lambda: (load, 0.0, 0.0))
    assert main(["doctor", "--json"]) == 0
    [found] = [one for one in json.loads(capsys.readouterr().out) if one["what"] == "processors"]
    assert found["state"] == state


def test_every_extra_of_the_package_is_looked_for(capsys):
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    main(["doctor", "--json"])
    found = {one["what"] for one in json.loads(capsys.readouterr().out)}
    assert {f"extra {name}" for name in project["optional-dependencies"] if name != "dev"} <= found


@pytest.mark.parametrize(("limit", "code", "state"), [(50, 1, "missing"), (4096, 0, "ok")])
def test_too_few_open_files_are_found_before_a_run_fails(capsys, monkeypatch, limit, code, state):
    monkeypatch.setattr(doctor_verb.resource, "getrlimit", lambda _which: (limit, limit))
    assert main(["doctor", "--json"]) == code
    [files] = [one for one in json.loads(capsys.readouterr().out) if one["what"] == "open files"]
    assert files["state"] == state


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
