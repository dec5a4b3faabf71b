"""`rampart bench`: which nodes and topics it takes, and a run of it."""

from __future__ import annotations

import json

import pytest

from rampart.actors.supervision.process_title import find_processes
from rampart.cli.main import main
from rampart.cli.operate.bench_verb import members_of, regular_topics, usual
from rampart.testing import RealRun
from tests import CELL


def test_all_nodes_are_killed_and_one_module_of_each_kind():
    members = members_of(str(CELL))
    assert usual(members) == [
        "camera", "part_finder", "motion_planner", "arm_controller", "gripper", "valve",
        "conveyor", "hmi", "cell_manager", "D_CURTAIN", "R_SAFE_TORQUE_OFF"]
    assert [topic.key for topic in regular_topics(members["gripper"])][-1] == "heartbeat/{name}"


@pytest.mark.parametrize(("arguments", "told"), [
    (["--kills", "0"], "--kills 0: must be between 1 and 1000"),
    (["--port", "31999"], "31999")])
def test_bad_usage_is_one_line(capsys, arguments, told):
    assert main(["bench", *arguments]) == 2
    said = capsys.readouterr()
    assert (said.out, said.err.count("\n")) == ("", 1)
    assert told in said.err


@pytest.mark.processes
def test_nodes_of_a_running_system_are_killed_and_come_back(tmp_path, capsys):
    with RealRun(tmp_path, CELL) as run:
        run.wait_until(lambda: run.pid("D_CURTAIN") is not None, 30, "no start")
        assert main(["bench", "--port", str(run.port), "--node", "nobody"]) == 2
        assert "unknown node 'nobody'" in capsys.readouterr().err
        assert main(["bench", "--port", str(run.port), "--node", "gripper", "--node", "D_CURTAIN",
                     "--kills", "2", "--json"]) == 0
        rows = json.loads(capsys.readouterr().out)
        assert [row["node"] for row in rows] == ["gripper", "D_CURTAIN"]
        for row in rows:
            assert (row["output"]["n"], row["failure"]) == (2, "")
            assert min(row["output_ms"] + row["detected_ms"]) > 0
        newest = {one.names[0]: one.incarnation for one in find_processes(run.port)}
        assert (newest["gripper"], newest["D_CURTAIN"]) == (3, 3)
