"""The manipulator cell: nothing in the engine is wired to the first system."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
import time

import pytest

from rampart.cli.main import main
from rampart.manager.spec.specification import parse_specification
from rampart.manager.spec.tables import SpecificationError
from rampart.testing import RealRun
from tests import CELL as FILE
from tests import ROOT

TEXT = FILE.read_text(encoding="utf-8")


WITHIN = 'against = { within_s = 0.45, hazard = "a hand is within the arm\'s reach" }'


@pytest.mark.parametrize(("old", "new", "message"), [
    ("heartbeat_timeout_s = 0.3\n", "heartbeat_timeout_s = 0.1\n", "would raise false alarms"),
    (WITHIN, "", "mechanism M_CURTAIN: against: the default 'drift' needs a [robot]"),
    (WITHIN, 'against = "runaway"', "mechanism M_CURTAIN: against = 'runaway': needs a [robot]"),
    ("within_s = 0.45", "within_s = 0.1", "M_CURTAIN needs 0.180 s (detection 0.030 + arbitration "
     "0.050 + actuation 0.100) of 0.100 s before a hand is within the arm's reach"),
    ("R_HOLD and R_OPEN_GRIPPER", "R_HOLD and R_RETRACT and R_OPEN_GRIPPER",
     "R_HOLD and R_RETRACT both claim arm; they cannot run together"),
])
def test_what_does_not_fit_a_system_without_a_robot_is_refused(old, new, message):
    assert old in TEXT
    with pytest.raises(SpecificationError, match=re.escape(message)):
        parse_specification(TEXT.replace(old, new, 1), "cell.toml")


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


@pytest.mark.parametrize("verb", ["cut-sets", "explain"])
def test_the_verbs_take_it(capsys, verb):
    assert main([verb, str(FILE), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)
