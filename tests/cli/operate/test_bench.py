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


@pytest.mark.processes
def test_nodes_of_a_running_system_are_killed_and_come_back(tmp_path, capsys, refused):
    with RealRun(tmp_path, CELL) as run:
        run.wait_until(lambda: run.pid("D_CURTAIN") is not None, 30, "no start")
        assert "unknown node 'nobody'" in refused("bench", "--port", run.port, "--node", "nobody")
        assert main(["bench", "--port", str(run.port), "--node", "gripper", "--node", "D_CURTAIN",
                     "--kills", "2", "--json"]) == 0
        rows = json.loads(capsys.readouterr().out)
        assert [row["node"] for row in rows] == ["gripper", "D_CURTAIN"]
        for row in rows:
            assert (row["output"]["n"], row["failure"]) == (2, "")
            assert min(row["output_ms"] + row["detected_ms"]) > 0
        newest = {one.names[0]: one.incarnation for one in find_processes(run.port)}
        assert (newest["gripper"], newest["D_CURTAIN"]) == (3, 3)
