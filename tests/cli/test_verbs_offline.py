"""The verbs of `rampart` that need no running system, and how it refuses nonsense."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tomllib
from pathlib import Path
from types import SimpleNamespace

import pytest

from rampart import systems as shipped
from rampart.actors.bus.run_info import RunInfo
from rampart.actors.foreign.program import LOGS
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.cli import completion, systems
from rampart.cli.look import doctor_verb
from rampart.cli.look.doctor_verb import Finding
from rampart.cli.look.topic_verbs import in_line, resolve
from rampart.cli.main import build_parser, main
from rampart.cli.operate import node_verbs
from rampart.cli.operate.inject_verb import choose
from rampart.cli.output import UsageError
from rampart.sim.campaign.job import read_document_of
from rampart.sim.osmosis.trial.faults import SENSOR_FAULTS
from rampart.testing.ports import free_base_port
from tests import CELL, ROOT
from tests.porter_actors import write_porter_system


@pytest.fixture(autouse=True)
def _the_papers_system(monkeypatch):
    """Its decisions are known by heart; the full system's are judged elsewhere."""
    monkeypatch.setattr(systems, "DEFAULT", shipped.SHIPPED / "paper.toml")


def told(capsys) -> str:
    return capsys.readouterr().out


def test_the_table_holds_every_non_empty_set_once_in_the_promised_shape(capsys):
    assert main(["decide", "--json"]) == 0
    rows = json.loads(told(capsys))
    assert len(rows) == 2**7 - 1
    assert len({tuple(row["active"]) for row in rows}) == 127
    assert all(set(row) == {"active", "block", "rm"} for row in rows)
    assert {"active": ["FTM7"], "block": 1, "rm": ["RM4"]} in rows


@pytest.mark.parametrize(("active", "block", "rm"), [
    (["FTM7"], 1, ["RM4"]), (["FTM1", "FTM6"], 2, ["RM1"]), (["FTM3", "FTM4"], 3, ["RM2"]),
    (["FTM2", "FTM6", "FTM5"], 4, ["RM1"]),
])
def test_a_decision_is_the_papers_with_path_and_rejected(capsys, active, block, rm):
    assert main(["decide", *active, "--json"]) == 0
    decision = json.loads(told(capsys))
    assert sorted(decision["active"]) == sorted(active)
    assert (decision["block"], decision["rm"]) == (block, rm)
    assert decision["path"]
    assert all(set(r) == {"name", "reason"} for r in decision["rejected"])
    assert main(["decide", *active]) == 0
    text = told(capsys)
    for shown in (*active, *rm, *decision["path"], *(r["reason"] for r in decision["rejected"])):
        assert shown in text


@pytest.fixture(autouse=True)
def _no_runs_of_others(monkeypatch):
    monkeypatch.setattr("rampart.actors.bus.run_info.find_runs", list)


@pytest.mark.parametrize("verb", [
    "cut-sets", "table", "tree", "topic list"])
def test_a_verb_takes_its_system_with_or_without_the_option(capsys, verb):
    shown = []
    for spec in ([str(CELL)], ["--system", str(CELL)], []):
        assert main([*verb.split(), *spec, "--json"]) == 0
        shown.append(told(capsys))
    assert shown[0] == shown[1] != shown[2]


@pytest.mark.parametrize(("arguments", "words"), [
    (["decide", "FTM9"], ["'FTM9'", "known: FTM1"]),
    (["table", "--strategy", "bravely"], ["'bravely'", "safety-first"]),
    (["table", "--system", "/no/such.toml"], ["/no/such.toml", "No such file"]),
    (["verify", "no.toml"], ["rampart: no.toml: No such file", "name of a shipped system: os"]),
    (["inject", "gremlins"], ["'gremlins'", "`rampart inject --list`"]),
    (["inject", "laser-drift"], ["'laser-drift'", "did you mean laser-dropout?"]),
    (["inject", "drop:no/such"], ["no run found"]),
    (["inject", "melt:plan/route"], ["'melt:plan/route'", "drop, freeze"]),
    (["inject", "corrupt:summit_xl/brake"], ["no number", "BrakeCommand"]),
    (["inject", "drop:world/truth"], ["judge"]),
    (["inject", "wrong-graph", "--system", "osmosis"], ["--system osmosis: only with --list"]),
    (["inject", "wrong-graph", "--ramp", "x_m=1"], ["--ramp", "only with corrupt:TOPIC"]),
    (["inject", "wrong-graph", "--share", "nan"], ["--share nan"]),
    (["inject", "wrong-graph", "--on", "1"], ["--off"]),
    (["inject", "wrong-graph", "--on", "1", "--off", "inf"], ["--off inf"]),
    (["inject", "corrupt:localization/pose", "--add", "z_m=1"], ["'z_m'", "x_m, y_m, yaw_rad"]),
    (["inject", "corrupt:plan/route", "--ramp", "step=up"], ["--ramp step=up: expected FIELD"]),
    (["inject", "corrupt:plan/route", "--set", "step"], ["--set step: expected FIELD=VALUE"]),
    (["inject", "corrupt:localization/pose", "--set", "x_m=far"], ["'x_m' = 'far'"]),
    (["inject", "corrupt:localization/pose", "--noise", "x_m=-1"], ["'x_m' = -1", "0 or more"]),
    (["inject", "obstacle-ahead"], ["--fault obstacle-ahead@"]),
    (["inject", "weak-wheel:nose"], ["unknown wheel 'nose'; known: front-left"]),
    (["inject", "stuck-wheel", "--seed", "5"], ["--seed: only with a fault of a topic"]),
    (["inject"], ["--list"]),
    (["inject", "wrong-graph", "--duration", "-1"], ["--duration -1"]),
    (["inject", "drop:detection/*"], ["no topic"]),
    (["inject", "kill:pump"], ["kill:pump: only from the start of a run, by --fault", "kill-node"]),
    (["topic", "info", "?"], ["unknown topic '?'; none of ", "is similar"]),
    (["topic", "info", "plan/rout"], ["'plan/rout'", "the nearest of", "plan/route"]),
    (["topic", "echo", "localization/pose/x"], ["no run found"]),
    (["topic", "echo", "localization/pose", "--duration", "0"], ["--duration 0"]),
    (["cut-sets", "nowhere.xml"], ["nowhere.xml: No such file or directory"]),
    (["cut-sets", "--limit", "-1"], ["--limit -1: must be 0 or more"]),
    (["cut-sets", "--top", "nobody"], ["unknown top 'nobody'"]),
    *((["adapt", "retune", "RM2", f"deadline_s={value}"], ["deadline_s", "finite"])
      for value in ("1e400", "nan", "[1.0, inf]")),
    (["joystick", "--speed", "7"], ["--speed 7: must be between"]),
    (["mission", "pause", "--reason", "two\nlines"], ["one line of 1 to 200 printable characters"]),
])
def test_nonsense_is_refused_in_one_line_that_names_it(refused, monkeypatch, arguments, words):
    monkeypatch.setattr("rampart.cli.session.find_run",
                        lambda _port: pytest.fail("looked for a run"))
    error = refused(*arguments)
    for word in words:
        assert word in error


@pytest.mark.parametrize("arguments", [
    ["status"], ["node", "list"], ["inject", "wrong-graph"],
    ["topic", "echo", "plan/route"], ["reset", "RM1"], ["obstacle", "remove", "crate"]])
def test_without_a_run_each_verb_says_so_and_exits_2(refused, arguments):
    assert refused(*arguments) == "rampart: no run found; start one with `python launch.py`\n"


def test_the_catalogue_is_listed_with_who_should_see_each_fault(capsys):
    assert main(["inject", "--list", "--json"]) == 0
    listed = {f["name"]: f["detected_by"] for f in json.loads(told(capsys))}
    assert (listed["wrong-graph"], listed["command-not-updated"]) == (["DM1"], ["DM2"])


@pytest.mark.parametrize(("arguments", "order"), [
    (["gps-noise", "--share", "0.3", "--on", "1", "--off", "4", "--seed", "7"], {
        "share": 0.3, "on_s": 1.0, "off_s": 4.0, "seed": 7,
        "noise_fields": SENSOR_FAULTS["gps-noise"].disturbances[0].noise_fields}),
    (["corrupt:summit_xl/scan", "--add", "ranges_f32=0.4", "--noise", "ranges_f32=0.2", "--seed",
      "3"], {"topic": "summit_xl/scan", "mode": "corrupt", "duration_s": 4.0, "seed": 3,
             "add_fields": {"ranges_f32": 0.4}, "noise_fields": {"ranges_f32": 0.2}}),
    (["corrupt:rampart/summit_xl/odom", "--set", "pose.y_m=2", "--ramp", "pose.x_m=0.5"], {
        "topic": "summit_xl/odom", "set_fields": {"pose.y_m": 2},
        "ramp_fields": {"pose.x_m": 0.5}}),
])
def test_a_fault_is_put_together_from_options(arguments, order):
    (made,) = choose(build_parser().parse_args(["inject", *arguments])).orders("i1", 4.0)
    assert {name: getattr(made, name) for name in order} == order


@pytest.mark.parametrize(("key", "topic", "full"), [
    ("/rampart/plan/route", topics.ROUTE, "rampart/plan/route"),
    ("detection/DM1", ftm_topics.DETECTION, "rampart/detection/DM1"),
    ("detection/*", ftm_topics.DETECTION, "rampart/detection/*"),
    ("recovery/{name}/command", ftm_topics.RECOVERY_COMMAND, "rampart/recovery/*/command"),
])
def test_a_key_is_found_however_it_is_written(key, topic, full):
    assert resolve(key, topics.ALL) == (topic, full)
    with pytest.raises(UsageError, match="unknown topic"):
        resolve(f"{key}/x", topics.ALL)


def test_long_bytes_are_counted_not_printed():
    scan = m.LaserScan(0.0, 0.1, 5.0, bytes(1440))
    assert in_line(scan).endswith('"ranges_f32":"<1440 bytes>","reference_m":-1.0}')


def test_topics_of_a_robot_s_own_actors_are_listed_and_described(capsys, tmp_path):
    own = ["--system", str(write_porter_system(tmp_path))]
    assert main(["topic", "list", "--json", *own]) == 0
    assert [topic["key"] for topic in json.loads(told(capsys))][-2:] == [
        "porter/load", "porter/axle/{name}"]
    assert main(["topic", "list", "--markdown", *own]) == 0
    assert "### Axle" in told(capsys)
    assert main(["topic", "info", "porter/axle/front", "--json", *own]) == 0
    info = json.loads(told(capsys))
    assert (info["publishers"], info["readers"]) == (["platform"], ["display"])
    assert main(["inject", "--list", *own]) == 0
    rows = [line.split(maxsplit=1) for line in told(capsys).splitlines() if len(line.split()) > 1]
    assert {"drop", "corrupt", "zero", "nan"} < set(dict(rows)["porter/load"].split())
    assert "corrupt" not in dict(rows)["porter/axle/{name}"].split()


def test_an_actor_that_cannot_be_loaded_is_one_line_and_needed_for_its_own_topics_only(
        refused, monkeypatch, tmp_path):
    file = write_porter_system(tmp_path)
    file.write_text(file.read_text().replace("tests.porter_actors:", "no_actors:"))
    run = RunInfo(1, 7450, 1.0, 0.0, str(file), "", (), "r1", 0, "test run")
    monkeypatch.setattr("rampart.cli.look.topic_verbs.find_run", lambda _port: run)
    for arguments in (["topic", "list", "--system", file], ["inject", "drop:porter/load"],
                      ["campaign", "--fault", "drop:porter/load", "--system", file]):
        assert "No module named 'no_actors'" in refused(*arguments)
    assert "no run found" in refused("topic", "echo", "plan/route")


def test_a_package_adds_verbs_and_one_that_is_broken_takes_no_other_along(monkeypatch, capsys):
    def add(verbs, formatter, common) -> None:
        verbs.add_parser("tank", parents=[common]).set_defaults(run=lambda options: options.port)

    def broken():
        raise ImportError("no tank")

    monkeypatch.setattr("rampart.cli.main.entry_points", lambda group: [
        SimpleNamespace(name="leak", value="leak:add", load=broken),
        SimpleNamespace(name="tank", value="tank:add", load=lambda: add)])
    assert main(["tank", "--port", "7"]) == 7
    assert capsys.readouterr().err == "rampart: verb leak (leak:add): ImportError: no tank\n"


def test_a_file_comes_before_a_system_that_ships_for_all_who_look_for_one(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "paper").mkdir()
    (tmp_path / "osmosis").write_text("")
    asked = ("paper", "osmosis", "nowhere", "x" * 300)
    assert [shipped.find(name) for name in asked] == [
        shipped.SHIPPED / "paper.toml", Path("osmosis"), Path("nowhere"), Path("x" * 300)]
    with pytest.raises(UsageError, match="name too long; expected a system file"):
        systems.load("x" * 300)
    assert systems.load("paper").name == "paper"
    (tmp_path / "paper").rmdir()
    (tmp_path / "paper").write_bytes(shipped.DEFAULT.read_bytes())
    assert systems.load("paper").name == "osmosis"
    read_document_of.cache_clear()  # what a campaign's job runs is what was checked
    assert read_document_of("paper")[1]["name"] == "osmosis"
    read_document_of.cache_clear()


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
    with pytest.raises(SystemExit):
        main(["campaign", "--help"])  # it takes the system's options, too: an own parser
    assert "rampart campaign --" in capsys.readouterr().out.partition("examples:")[2]


def test_verbs_topics_and_faults_are_offered(tmp_path):
    """As argcomplete's shell function asks for what may stand at the end of a line."""
    for line, some in (("rampart topic echo localization/p", "localization/pose"),
                       ("rampart inject gps-b", "gps-bias")):
        subprocess.run([sys.executable, "-m", "rampart.cli.main"], check=True, timeout=30, env={
            **os.environ, "COMP_LINE": line, "COMP_POINT": str(len(line)), "COMP_TYPE": "9",
            "_ARGCOMPLETE": "1", "IFS": "\013",
            "_ARGCOMPLETE_STDOUT_FILENAME": str(tmp_path / "told"),
            "RAMPART_PORT": str(free_base_port())})  # no run is there, whatever else runs
        offered = (tmp_path / "told").read_text().split("\013")
        assert some in {word.strip() for word in offered}


def test_nodes_are_those_of_all_runs(monkeypatch):
    monkeypatch.setattr(completion, "find_runs", lambda: [
        SimpleNamespace(nodes=("pump", "valve")), SimpleNamespace(nodes=("pump",))])
    assert completion.nodes() == ["pump", "valve"]


def test_the_last_lines_are_of_both_files_and_harm_no_terminal(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(node_verbs, "find_run", lambda _port: SimpleNamespace(
        folder=str(tmp_path), nodes=("wheels", "driver")))
    (tmp_path / LOGS).mkdir()
    file = tmp_path / LOGS / "wheels.log"
    file.write_bytes(b"3\n\x1b[2J\tclear\xff\r\n")
    (tmp_path / LOGS / "wheels.log.1").write_text("1\n2\n")
    assert main(["node", "log", "wheels", "--lines", "3"]) == 0
    assert capsys.readouterr().out == "2\n3\n\\u001b[2J\tclear\ufffd\n"
    assert main(["node", "log", "driver"]) == 1
    assert capsys.readouterr().err.endswith("nodes with output: wheels\n")
    assert main(["node", "log", "wheel"]) == 2


NO_RUN = "rampart: --port 31999: no run there; runs found: "


@pytest.mark.parametrize("arguments", [
    "adapt set strategy guarded-repair --port 31999", "node list --json --port 31999",
    "topic echo no/such --port 31999", "inject drop:no/such --port 31999"])
def test_that_there_is_no_run_is_said_before_anything_else(refused, arguments):
    assert refused(*arguments.split()).startswith(NO_RUN)


def test_the_environment_names_the_run(refused, monkeypatch):
    monkeypatch.setenv("RAMPART_PORT", "31999")
    assert refused("status").startswith(NO_RUN)
    assert refused("status", "--port", "31998").startswith("rampart: --port 31998: ")
    monkeypatch.setenv("RAMPART_PORT", "74x0")
    assert "RAMPART_PORT=74x0: expected a whole number" in refused("status")


def test_every_object_says_its_format(capsys):
    for arguments in (("check", str(CELL)), ("explain", str(CELL)), (
            "decide", "M_CURTAIN", "--system", str(CELL)), (
            "topic", "info", "manager/status", "--system", str(CELL))):
        assert main([*arguments, "--json"]) == 0
        assert next(iter(json.loads(capsys.readouterr().out).items())) == ("format", 1)
