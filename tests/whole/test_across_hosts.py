"""What the first host keeps for the others: checkpoints."""

from __future__ import annotations

import json
import shutil
import signal
import time
from pathlib import Path

import pytest

from rampart.actors.recording.bag_reader import BagReader
from tests import ROOT
from tests.whole.network import Line, Network, network, why_not
from tests.whole.test_two_hosts import CELL_ON_GROUND, host, specification, with_keys

pytestmark = [pytest.mark.processes, pytest.mark.alone,
              pytest.mark.skipif(bool(why_not()), reason=f"no two hosts here: {why_not()}")]


@pytest.fixture
def net():
    with network(["robot", "ground"]) as made:
        yield made


def counted(file: Path) -> dict[int, tuple[int, int]]:
    """Return by incarnation how far the camera had come at first, and before there was a higher."""
    found: dict[int, tuple[int, int]] = {}
    for channel, message in BagReader(file).messages():
        if channel.topic == "counting/counted":
            told = json.loads(message.data)
            incarnation, number = told["incarnation"], told["body"]["number"]
            if incarnation >= max(found, default=0):
                found[incarnation] = found.get(incarnation, (number, 0))[0], number
    return found


def with_a_camera_that_counts(net: Network, folder: Path) -> Path:
    """Return the specification of a cell whose camera keeps how far it has counted."""
    spec = specification(net, folder, CELL_ON_GROUND, "cell", 0.1)
    spec.write_text(spec.read_text(encoding="utf-8").replace(
        'actor = "rampart.actors.runtime.stub_node:StubNode"',
        'actor = "counting_actor:Counting"', 1), encoding="utf-8")
    shutil.copy(ROOT / "tests" / "counting_actor.py", folder)
    return spec


@pytest.mark.parametrize("keyed", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_node_goes_on_from_its_checkpoint_on_the_first_host_and_from_that_one_s_at_home(
        net, tmp_path, keyed):
    spec = with_a_camera_that_counts(net, tmp_path)
    own = with_keys(tmp_path, spec) if keyed else dict.fromkeys(net.addresses, ("--no-keys",))
    file = tmp_path / "run.mcap"
    with (host(net, "ground", tmp_path / "g", spec, *own["ground"]) as ground,
          host(net, "robot", tmp_path / "r", spec, *own["robot"], "--record", str(file)) as robot):
        ground.wait_for("takes part in run")
        robot.wait_for("ctrl-C ends it")
        ground.wait_for("router_b_ground adopted")
        time.sleep(3.0)
        net.line = Line(is_cut=True)
        robot.wait_for("camera respawned by supervisor, incarnation 1000001")
        time.sleep(3.0)
        net.line = Line()
        ground.wait_for("camera handed over")
        ground.wait_for("camera respawned", 20)
        time.sleep(3.0)
        ground.process.send_signal(signal.SIGKILL)  # as a whole: its disk is gone with it
        robot.wait_until(lambda: robot.story.count("supervisor_ground unreachable") > 1, 10,
                         "the loss of the other host was not told")
        robot.wait_until(lambda: robot.pid("camera") is not None, 5, "not taken over")
        time.sleep(1.0)
        with host(net, "ground", tmp_path / "again", spec, *own["ground"]) as again:
            again.wait_for("takes part in run")
            again.wait_for("camera respawned")
            time.sleep(2.0)
            robot.process.send_signal(signal.SIGINT)
            assert robot.result(20)[0] == 0
    numbers = counted(file)
    assert [incarnation // 1_000_000 for incarnation in numbers] == [0, 1, 1, 2, 2], numbers
    (_, last), *later = numbers.values()
    for first, end in later:  # twenty a second: what was under way when the line was cut is lost
        assert last - 10 < first <= last + 10, numbers
        last = end
    assert last > 100, numbers
    assert "camera: checkpoint" not in robot.story  # nothing was wrong with one
