"""What one host sees of the others, and keeps for them: processes, recordings, checkpoints."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from rampart.testing import RealRun
from tests.whole.network import Line, Network, network, why_not
from tests.whole.test_two_hosts import CELL_ON_GROUND, host, specification

pytestmark = [pytest.mark.processes, pytest.mark.alone,
              pytest.mark.skipif(bool(why_not()), reason=f"no two hosts here: {why_not()}")]


@pytest.fixture
def net():
    with network(["robot", "ground"]) as made:
        yield made


def listed(net: Network, name: str, run: RealRun) -> tuple[dict[str, str], str]:
    """Return each node that `kill-node --list` lists on a host, with its host, and what it tells."""
    done = subprocess.run(
        net.command(name, sys.executable, "-P", "-m", "rampart.cli.operate.kill_elsewhere",
                    "--list", "--json", "--port", str(run.port)),
        capture_output=True, text=True, check=True, timeout=30)
    return {row["name"]: row["host"] for row in json.loads(done.stdout)}, done.stderr


def test_the_first_host_sees_what_the_other_does_and_goes_on_from_where_it_was(net, tmp_path):
    spec = specification(net, tmp_path, CELL_ON_GROUND, "cell", 0.1)
    with (host(net, "ground", tmp_path / "g", spec, "--no-keys") as ground,
          host(net, "robot", tmp_path / "r", spec, "--no-keys") as robot):
        ground.wait_for("takes part in run")
        robot.wait_for("ctrl-C ends it")
        ground.wait_for("router_b_ground adopted")
        for name, run in (("robot", robot), ("ground", ground)):
            found, told = listed(net, name, run)
            assert {found[node] for node in (*CELL_ON_GROUND, "supervisor_ground")} == {"ground"}
            assert {found[node] for node in ("gripper", "supervisor", "router_a")} == {"robot"}
            assert told == ""
        net.line = Line(is_cut=True)
        robot.wait_for("camera respawned, incarnation 1000001")
        found, told = listed(net, "robot", robot)
        assert found["camera"] == "robot"
        assert "supervisor_ground" not in found
        assert told == "kill-node: the processes of ground are missing: nothing was heard\n"
