"""One system on two machines: network namespaces, joined by a line that may be bad, or cut."""

import json
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import pytest

from rampart.actors.ftm import topics
from rampart.actors.recording.bag_reader import BagReader, Summary, key_of
from rampart.actors.recording.message_form import Forms, header_of
from rampart.testing import RealRun
from tests import ROOT
from tests.two_hosts import several_hosts, two_hosts
from tests.whole.network import Line, Network, network, why_not

pytestmark = [pytest.mark.processes, pytest.mark.alone,
              pytest.mark.skipif(bool(why_not()), reason=f"no two hosts here: {why_not()}")]

BAD = {"delay_s": 0.05, "jitter_s": 0.01, "loss": 0.05}
KILL_NODE = "rampart.cli.operate.kill_node"
CELL_ON_GROUND = ("camera", "part_finder", "D_VISION_CRASH")


class Host(RealRun):
    """A host that takes part, the robot's as the first."""

    def __init__(self, net: Network, name: str, folder: Path, spec: Path, *arguments: str) -> None:
        folder.mkdir()
        self._python = net.command(name, sys.executable, "-P", "-m")
        self.command = (*self._python, "rampart.cli.run")
        super().__init__(folder, spec, *(["--host", name] if name != "robot" else []), *arguments)

    def tool(self, *words: str, program: str = "rampart.cli.main"
             ) -> subprocess.CompletedProcess[str]:
        """Run a verb of `rampart` there, or another program."""
        return subprocess.run([*self._python, program, *words, "--port", str(self.port)],
                              capture_output=True, text=True, check=False, timeout=60)

    def listed(self) -> dict[str, str]:
        """Return each node that `rampart node list` lists, with its host, "" for the first."""
        rows = json.loads(self.tool("node", "list", "--json").stdout)
        return {row["name"]: row.get("host", "") for row in rows}


@pytest.fixture
def net(request):
    with network(getattr(request, "param", ("robot", "ground"))) as made:
        yield made


def specification(net: Network, folder: Path, *arguments: object) -> Path:
    file = folder / "two.toml"
    file.write_text(two_hosts(net.addresses, *arguments), encoding="utf-8")
    return file


def with_keys(folder: Path, spec: Path) -> dict[str, tuple[str, ...]]:
    """Return the arguments of each host by which it uses what it was given of a folder of keys."""
    def keys(*arguments: object) -> None:
        subprocess.run([sys.executable, "-m", "rampart.cli.main", "keys", *map(str, arguments)],
                       check=True, capture_output=True, cwd=folder, timeout=60)

    keys("init")
    keys("issue", "--system", spec, "--operator", "ada")
    for name in ("robot", "ground"):
        keys("share", name, "--system", spec, "--to", name, "--person", "ada")
    return {name: ("--keys", str(folder / name)) for name in ("robot", "ground")}


def recorded(file: Path) -> tuple[Counter[str], Summary]:
    """Return how many messages of each source a recording has, and what else is in it."""
    forms, reader, sources = Forms(topics.ALL), BagReader(file), Counter[str]()
    for channel, message in reader.messages():
        if (key := key_of(channel)) and (header := header_of(forms.of(key).payload(message.data))):
            sources[header.source] += 1
    return sources, Summary(BagReader(file))


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
def test_what_a_host_ran_that_cannot_be_reached_goes_on_on_the_first_until_it_is_back(
        net, tmp_path, keyed):
    """From its checkpoint, each time: on the first host, and at home from that one's."""
    spec = with_a_camera_that_counts(net, tmp_path)
    own = with_keys(tmp_path, spec) if keyed else dict.fromkeys(net.addresses, ("--no-keys",))
    file = tmp_path / "run.mcap"
    with (Host(net, "ground", tmp_path / "g", spec, *own["ground"]) as ground,
          Host(net, "robot", tmp_path / "r", spec, *own["robot"], "--record", str(file)) as robot):
        ground.wait_for("takes part in run")
        robot.wait_for("ctrl-C ends it")
        ground.wait_for("router_b_ground adopted")
        for run in (robot, ground):
            found = run.listed()
            assert {found[node] for node in (*CELL_ON_GROUND, "supervisor_ground")} == {"ground"}
            assert {found[node] for node in ("gripper", "supervisor", "router_a")} == {""}
        # On the other host, too, while the run goes on.
        beside = ground.tool("record", str(tmp_path / "beside.mcap"), "--duration", "2")
        assert beside.returncode == 0, beside.stderr
        ground.kill("camera")
        robot.wait_for("camera respawned by R_RESTART_VISION, incarnation 2")
        assert robot.pid("camera") is None
        killed = robot.tool("camera", program=KILL_NODE)
        assert killed.stdout.startswith("camera (pid "), killed.stderr
        robot.wait_for("camera respawned by R_RESTART_VISION, incarnation 3")
        refused = robot.tool("kamera", program=KILL_NODE)
        assert refused.returncode == 2
        assert "kill-node: unknown node 'kamera'" in refused.stderr
        net.line = Line(is_cut=True)
        robot.wait_for("supervisor_ground unreachable")
        robot.wait_for("camera respawned by supervisor, incarnation 1000001")
        ground.wait_for("supervisor unreachable host the first")
        robot.wait_until(lambda: None not in map(robot.pid, CELL_ON_GROUND), 5, "not taken over")
        assert ground.pid("camera") is not None  # it knows nothing of it
        assert robot.listed()["camera"] == ""
        net.line = Line(**BAD)
        ground.wait_for("camera handed over")
        robot.wait_for("supervisor_ground back")
        robot.wait_for("camera handed over, incarnation 1000001")
        ground.wait_for("camera respawned")
        robot.wait_until(lambda: not any(map(robot.pid, CELL_ON_GROUND)), 5, "not given back")
        net.line = Line()
        time.sleep(2.0)  # for the copies of states that waited for the line
        before = len(robot.story)
        ground.process.send_signal(signal.SIGKILL)  # as a whole: its disk is gone with it
        robot.wait_until(lambda: "supervisor_ground unreachable" in robot.story[before:], 10,
                         "the loss of the other host was not told")
        robot.wait_until(lambda: None not in map(robot.pid, CELL_ON_GROUND), 5, "not taken over")
        time.sleep(1.0)
        with Host(net, "ground", tmp_path / "again", spec, *own["ground"]) as again:
            again.wait_for("takes part in run")
            again.wait_for("camera respawned")
            robot.wait_until(lambda: not any(map(robot.pid, CELL_ON_GROUND)), 5, "not given back")
            time.sleep(1.0)
            robot.process.send_signal(signal.SIGINT)
            code, _ = robot.result(20)
            assert again.result(20)[0] == 0
    assert code == 0
    assert not [line for line in robot.story.splitlines() if "failed" in line]
    sources, _ = recorded(tmp_path / "beside.mcap")
    assert all(sources[node] > 10 for node in ("camera", "gripper", "router_a")), sources
    sources, summary = recorded(file)
    for node in (*CELL_ON_GROUND, "supervisor_ground", "router_a_ground", "observer_ground"):
        assert sources[node] > 10, (node, sources)
    assert sources["gripper"] > 10
    assert not {"gripper", "supervisor", "cell_manager"} & json.loads(summary.end["lost"]).keys()
    numbers = counted(file)
    assert [incarnation // 1_000_000 for incarnation in numbers] == [0] * 3 + [1, 1, 2, 2], numbers
    (_, last), *later = numbers.values()
    for first, end in later:  # twenty a second: what was under way when the line was cut is lost
        assert last - 10 < first <= last + 10, numbers
        last = end
    assert last > 100, numbers
    assert "camera: checkpoint" not in robot.story  # nothing was wrong with one


def test_the_manager_survives_its_machine_and_never_are_two_obeyed(net, tmp_path):
    spec = specification(net, tmp_path, ("cell_manager",), "cell", 0.07)

    def trigger(run: RealRun, module: str) -> None:
        done = run.tool("trigger", module, "--for", "1")
        assert done.returncode == 0, done.stderr

    with (Host(net, "ground", tmp_path / "g", spec, "--no-keys") as ground,
          Host(net, "robot", tmp_path / "r", spec, "--no-keys") as robot):
        ground.wait_for("takes part in run")
        robot.wait_for("ctrl-C ends it")
        time.sleep(3.0)
        trigger(robot, "D_CURTAIN")
        robot.wait_for("(R_SAFE_TORQUE_OFF): ")
        net.line = Line(is_cut=True)
        robot.wait_for("cell_manager respawned by supervisor, incarnation 1000001")
        assert ground.pid("cell_manager") is not None  # it goes on, and nobody here hears it
        before = len(robot.story)
        trigger(robot, "D_CURTAIN")  # heard, too, after the links were closed: 2 s after the cut
        robot.wait_until(lambda: "(M_CURTAIN)" in robot.story[before:], 10, "no manager")
        net.line = Line()
        ground.wait_for("cell_manager handed over")
        ground.wait_for("cell_manager respawned", 20)
        robot.wait_until(lambda: robot.pid("cell_manager") is None, 10, "not given back")
        robot.process.send_signal(signal.SIGINT)
        code, result = robot.result(20)
    assert code == 0
    numbers = [decision["number"] for decision in result["decisions"]]
    assert numbers == sorted(set(numbers))  # one after the other, and none given twice
    refused = [line for line in robot.story.splitlines() if "incarnation 1 of cell_manager" in line]
    assert all("was superseded by 1000001" in line for line in refused)


ON_GROUND, ON_DESK = ("camera",), ("part_finder", "D_VISION_CRASH")
DELAY_S = 0.08
BEGINS_S = 6.0
"""From when all take part until simulated time begins, and modules detect."""


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


@pytest.mark.slow
@pytest.mark.parametrize("net", [("robot", "ground", "desk")], indirect=True)
def test_of_three_hosts_each_may_lose_each_and_the_third_is_a_way_round(net, tmp_path):
    spec = tmp_path / "three.toml"
    spec.write_text(several_hosts(net.addresses, {"ground": ON_GROUND, "desk": ON_DESK}, "cell",
                                  DELAY_S), encoding="utf-8")
    with (Host(net, "ground", tmp_path / "g", spec, "--no-keys") as ground,
          Host(net, "desk", tmp_path / "d", spec, "--no-keys") as desk,
          Host(net, "robot", tmp_path / "r", spec, "--no-keys") as robot):
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
