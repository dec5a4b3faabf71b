"""The manipulator cell: nothing in the engine is wired to the first system."""

from __future__ import annotations

import ast
import json
import re
import signal
import subprocess
import sys
import time

import pytest

from rampart.manager.model.gates import detection_gate
from rampart.manager.spec.schema import Within
from rampart.manager.spec.specification import parse_specification
from rampart.manager.spec.tables import SpecificationError
from rampart.manager.strategies.registry import decide
from rampart.testing import RealRun
from tests import CELL as FILE
from tests import ROOT

TEXT = FILE.read_text(encoding="utf-8")
CELL = parse_specification(TEXT, "cell.toml")


def test_its_ftm_tree_follows_from_a_fault_tree_with_and_or_k_of_n_and_a_common_cause():
    assert CELL.build_ftm_tree().parents == {
        "M_CURTAIN": None, "M_ENCODERS": "M_CURTAIN", "M_CONTACT": "M_CURTAIN",
        "M_MISSED_PART": "M_CURTAIN", "M_MOTION": "M_ENCODERS", "M_VISION": "M_MISSED_PART"}
    gates = {(e.required, len(e.of)) for e in CELL.events if e.required}
    assert {(2, 2), (1, 2), (2, 3)} <= gates
    assert len(CELL.build_fault_tree().parents["power_dip"]) == 4


@pytest.mark.parametrize(("detections", "active"), [
    (["D_ENCODER_A"], ()),
    (["D_ENCODER_A", "D_ENCODER_C"], ("M_ENCODERS",)),
    (["D_FORCE"], ()),
    (["D_VISION"], ("M_MISSED_PART",)),
    (["D_FORCE", "D_VISION"], ("M_CONTACT",)),
])
def test_gates_decide_which_mechanisms_are_active(detections, active):
    assert CELL.build_mechanisms().detected_by(detections) == active


def test_both_recoveries_of_a_compound_run_together():
    decision = decide(["M_CONTACT"], CELL.build_mechanisms(), CELL.build_ftm_tree(),
                      CELL.build_order(), CELL.strategy)
    assert decision.recoveries == ("R_HOLD", "R_OPEN_GRIPPER")


def test_the_second_order_decides_what_the_first_leaves_open():
    assert not CELL.build_safety_order().is_above("R_RESTART_VISION", "R_RESTART_MOTION")
    assert CELL.build_order().is_above("R_RESTART_VISION", "R_RESTART_MOTION")


@pytest.mark.parametrize("room", ["manager", "actors", "cli", "sim/virtual", "sim/runs"])
def test_no_name_of_the_first_system_is_in_the_engine_s_code(room):
    """Docstrings and help texts may give examples; what decides may not know a name."""
    for path in sorted((ROOT / room).rglob("*.py")):
        if "osmosis" in path.parts:
            continue
        tree = ast.parse(path.read_text(encoding="utf-8"))
        shown = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
        shown |= {id(c) for node in ast.walk(tree) if isinstance(node, ast.JoinedStr)
                  for c in ast.walk(node)}
        for node in ast.walk(tree):
            if isinstance(node, ast.Constant) and isinstance(node.value, str) \
                    and id(node) not in shown:
                assert not re.fullmatch(r"(FTM|DM|RM)\d+", node.value), f"{path}: {node.value}"


@pytest.mark.parametrize(("old", "new", "message"), [
    ("heartbeat_timeout_s = 0.3\n", "heartbeat_timeout_s = 0.1\n",
     "cell.toml: $.timing.heartbeat_timeout_s = 0.1: would raise false alarms; at least 0.300 s, "
     "3 periods of heartbeat_period_s = 0.100 s, is right"),
    ('against = { within_s = 0.45, hazard = "a hand is within the arm\'s reach" }',
     'against = "drift"',
     "cell.toml: mechanism M_CURTAIN: against: 'drift', which it is if left out, needs a [robot]; "
     "'parent' or { within_s = ..., hazard = '...' } is right"),
    ('against = { within_s = 0.45, hazard = "a hand is within the arm\'s reach" }', "",
     "cell.toml: mechanism M_CURTAIN: against: 'drift', which it is if left out, needs a [robot]; "
     "'parent' or { within_s = ..., hazard = '...' } is right"),
    ('against = { within_s = 0.45, hazard = "a hand is within the arm\'s reach" }',
     'against = "runaway"',
     "cell.toml: mechanism M_CURTAIN: against = 'runaway': needs a [robot]; 'parent' or "
     "{ within_s = ..., hazard = '...' } is right"),
    ("within_s = 0.45", "within_s = 0.1",
     "cell.toml: $.timing: the time budget does not fit: M_CURTAIN needs 0.180 s (detection 0.030 "
     "+ arbitration 0.050 + actuation 0.100) of 0.100 s before a hand is within the arm's reach"),
    ('order = ["safer", "autonomy"]', 'order = ["safer", "comfort"]',
     "cell.toml: $.order = 'comfort': unknown order; known: safer, autonomy"),
    ('order = ["safer", "autonomy"]', 'order = ["safer", "safer"]',
     "cell.toml: $.order = ['safer', 'safer']: 'safer' is listed twice"),
    ("D_FORCE and D_VISION", "D_FORCE and not D_FORCE",
     "cell.toml: mechanism M_CONTACT: detect = 'D_FORCE and not D_FORCE': it can never be active"),
    ("R_HOLD and R_OPEN_GRIPPER", "R_HOLD and R_RETRACT and R_OPEN_GRIPPER",
     "cell.toml: mechanism M_CONTACT: recover = 'R_HOLD and R_RETRACT and R_OPEN_GRIPPER': R_HOLD "
     "and R_RETRACT both claim arm; they cannot run together"),
    ('title = "Pick and place behind a light curtain"\n',
     'title = "x"\nairport = "vallombre"\n',
     "cell.toml: $.airport = 'vallombre': unknown field; known: name, title, application, judge, "
     "end, host, link, robot, strategy, shadow, order, timing, layers, supervision, node, "
     "detection, recovery, mechanism, event, orders, fault, panel, ros2"),
    ('shadow', 'shadow', None),
])
def test_refused(old, new, message):
    if message is None:
        text = TEXT.replace('strategy = "guarded-repair"',
                            'strategy = "guarded-repair"\nshadow = "bold"')
        message = ("cell.toml: $.shadow = 'bold': unknown strategy; known: guarded-repair, "
                   "mission-first, safety-first, simultaneous")
    else:
        assert old in TEXT
        text = TEXT.replace(old, new, 1)
    with pytest.raises(SpecificationError) as caught:
        parse_specification(text, "cell.toml")
    assert str(caught.value) == message


def test_hazards_are_in_the_user_s_own_words():
    assert all(isinstance(m.against, Within) for m in CELL.mechanisms)
    assert detection_gate(CELL.mechanisms[1].detect).required == 2


@pytest.mark.processes
def test_it_runs_its_dead_nodes_come_back_and_what_is_triggered_is_recovered_from(tmp_path):
    with RealRun(tmp_path, str(FILE), "--duration", "40") as run:
        run.wait_for("ctrl-C ends it")
        run.sleep_until(1.0)
        run.kill("arm_controller")
        run.wait_for("(R_RESTART_MOTION): ")
        run.wait_for("arm_controller respawned")
        first = subprocess.Popen([sys.executable, "-m", "rampart.cli.main", "trigger",
                                  "D_ENCODER_B",
                                  "--for", "4", "--port", str(run.port)], cwd=ROOT,
                                 stdout=subprocess.DEVNULL)
        try:
            run.wait_for("(D_ENCODER_B): triggered by hand")
            time.sleep(0.3)
            assert "R_HOLD" not in run.story
            done = run.tool("trigger", "D_ENCODER_C", "--for", "0.5")
            assert done.returncode == 0, done.stderr
            assert "(R_HOLD): " in run.story
        finally:
            first.wait(20)
        assert run.tool("trigger", "gripper").returncode == 2
        run.process.send_signal(signal.SIGINT)
        code, result = run.result(20)
    assert code == 0
    assert result["mission"] is None
    assert result["restarts"]["arm_controller"] == 1
    assert [d["recoveries"] for d in result["decisions"]][:1] == [["R_RESTART_MOTION"]]


@pytest.mark.parametrize(("arguments", "words"), [
    (["--system", str(FILE), "--mission", "A"], "--mission: no option of the launcher or of cell"),
    (["--system", str(FILE), "--duration", "-1"], "--duration -1: must be above 0"),
    (["--duration", "5"], "--duration 5: a mission ends by itself"),
    (["--shadow", "bold"], "--shadow bold: unknown strategy; known: safety-first"),
])
def test_bad_usage_is_one_line(arguments, words, tmp_path):
    done = subprocess.run([sys.executable, str(ROOT / "launch.py"), *arguments], cwd=tmp_path,
                          capture_output=True, text=True, check=False, timeout=30)
    assert done.returncode == 2
    assert words in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


def test_the_verbs_take_it():
    for verb in (["verify", str(FILE), "--json"], ["cut-sets", str(FILE), "--json"],
                 ["table", "--system", str(FILE), "--json"]):
        done = subprocess.run([sys.executable, "-m", "rampart.cli.main", *verb], cwd=ROOT,
                              capture_output=True, text=True, check=False, timeout=60)
        assert done.returncode == 0, done.stderr
        assert json.loads(done.stdout)


def test_under_its_own_strategy_every_property_holds():
    done = subprocess.run(
        [sys.executable, "-m", "rampart.cli.main", "verify", str(FILE), "--strict",
         "--strategy", CELL.strategy], cwd=ROOT, capture_output=True, text=True, check=False,
        timeout=60)
    assert done.returncode == 0, done.stdout
