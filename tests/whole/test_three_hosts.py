"""One system on three machines, of which any two may lose each other: the third is a way round."""

from __future__ import annotations

import signal
import time
from pathlib import Path

import pytest

from rampart.testing import RealRun
from tests.two_hosts import several_hosts
from tests.whole.network import Line, network, why_not
from tests.whole.test_two_hosts import BAD, host

pytestmark = [pytest.mark.processes, pytest.mark.alone, pytest.mark.slow,
              pytest.mark.skipif(bool(why_not()), reason=f"no three hosts here: {why_not()}")]

ON_GROUND, ON_DESK = ("camera",), ("part_finder", "D_VISION_CRASH")
DELAY_S = 0.08
BEGINS_S = 6.0
"""From when all take part until simulated time begins, and modules detect."""


@pytest.fixture
def net():
    with network(["robot", "ground", "desk"]) as made:
        yield made


LINKED_S = 5.0
"""Until then all routers are linked to each other again, and no detour is in use."""

FLAPPED_S = 20.0
"""A host that was lost again so soon is back after up to so many seconds more."""


def has(run: RealRun, nodes: tuple[str, ...], *, run_here: bool, within_s: float = 15.0) -> None:
    """Wait until a host runs all of these nodes, or none."""
    run.wait_until(lambda: all((run.pid(node) is not None) == run_here for node in nodes), within_s,
                   f"{nodes} {'not ' * run_here}there")


def comes_back(home: RealRun, robot: RealRun) -> None:
    """Kill the camera; the desk's module detects it, the robot's restarts it, the desk's knows."""
    before = robot.story.count("(D_VISION_CRASH): clear")
    home.kill("camera")
    robot.wait_until(lambda: robot.story.count("(D_VISION_CRASH): clear") > before, 10, "not back")


def test_each_may_lose_each(net, tmp_path: Path):
    spec = tmp_path / "three.toml"
    spec.write_text(several_hosts(net.addresses, {"ground": ON_GROUND, "desk": ON_DESK}, "cell",
                                  DELAY_S), encoding="utf-8")
    with (host(net, "ground", tmp_path / "g", spec, "--no-keys") as ground,
          host(net, "desk", tmp_path / "d", spec, "--no-keys") as desk,
          host(net, "robot", tmp_path / "r", spec, "--no-keys") as robot):
        for name, run in (("ground", ground), ("desk", desk)):
            run.wait_for("takes part in run")
            run.wait_for(f"router_b_{name} adopted")
        robot.wait_for("ctrl-C ends it")
        time.sleep(BEGINS_S)
        comes_back(ground, robot)
        net.part(("ground", "desk"))
        ground.wait_for("supervisor_desk unreachable")
        ground.wait_for("supervisor_desk back")  # by way of the robot
        comes_back(ground, robot)
        assert "as seen from the first" not in robot.story
        net.part(("ground", "desk"), ("ground", "robot"))
        robot.wait_for("camera respawned by supervisor, incarnation 1000001")
        has(robot, ON_GROUND, run_here=True)
        comes_back(robot, robot)
        net.part()
        has(robot, ON_GROUND, run_here=False)
        has(ground, ON_GROUND, run_here=True)
        time.sleep(LINKED_S)
        net.part(("ground", "robot"))
        robot.wait_for("camera respawned by supervisor, incarnation 2000001")
        robot.wait_for("camera handed over, incarnation 2000001")  # heard by way of the desk
        has(robot, ON_GROUND, run_here=False)
        comes_back(ground, robot)
        net.part()
        desk.process.send_signal(signal.SIGKILL)
        has(robot, ON_DESK, run_here=True)
        has(ground, ON_GROUND, run_here=True)
        net.line = Line(is_cut=True)
        has(robot, ON_GROUND + ON_DESK, run_here=True)
        net.line = Line(**BAD)
        has(robot, ON_GROUND, run_here=False, within_s=15 + FLAPPED_S)
        has(ground, ON_GROUND, run_here=True)
        time.sleep(1.0)
        robot.process.send_signal(signal.SIGINT)
        assert robot.result(20)[0] == 0
        assert ground.result(20)[0] == 0
    assert not [line for line in robot.story.splitlines() if "failed" in line]
