"""`rampart bench`: what it refuses, its systems, and a run of it in its smallest form."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from rampart.actors.foreign.descendants import descendants
from rampart.actors.machine.unix_peer import process_state
from rampart.actors.runtime.run_plan import RunPlan, load_system
from rampart.actors.system.layout import Layout
from rampart.cli.bench.measuring import bench  # noqa: F401 imported once, before a test is timed
from rampart.cli.bench.peers import OURS
from rampart.cli.bench.processes.observer import Heard
from rampart.cli.bench.restart import members_of, output_of, regular_topics, usual
from rampart.cli.bench.systems import BESIDES, peers_system, sized_system, talking_system
from rampart.cli.main import main
from rampart.testing import wait_until
from tests import CELL


@pytest.mark.parametrize(("arguments", "told"), [
    (["--kills", "0"], "--kills 0: must be between 1 and 1000"),
    (["--peer", "docker"], "unknown peer 'docker'; known: dora, supervisord, circus, subprocess, "
                           "rampart-actor, rampart-command"),
    (["--only", "floors", "--peer", "dora"], "--peer: only with the part peers; leave out --only, "
                                             "or say --only peers"),
    (["--only", "size", "--node", "x"], "--node: only with the part restart or keys; leave "
                                        "out --only, or say --only restart"),
    (["--sizes", "10,many"], "--sizes 10,many: 'many' is no number of processes; whole numbers "
                             "with commas between are right, as 10,35,70,140"),
    (["--sizes", "8"], "--sizes 8: must be between 9 and 500"),
    (["--system", "nowhere.toml"], "nowhere.toml: No such file or directory; a spec is right, or "
                                   "the name of a shipped one: osmosis, osmosis-ros2, paper"),
    (["--only", "restart", "--system", str(CELL), "--node", "grip"], "unknown node 'grip'; "),
    (["--only", "size", "--out", "FILE"], "--out FILE: no directory that can be written "
                                          "(File exists)")])
def test_what_makes_no_sense_is_refused_in_one_line(
        tmp_path, monkeypatch, capsys, arguments, told):
    monkeypatch.chdir(tmp_path)
    Path("FILE").write_text("")
    assert main(["bench", *arguments]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.startswith(f"rampart: {told}")
    assert said.err.count("\n") == 1


@pytest.mark.parametrize(("text", "nodes"), [
    (peers_system(["/bin/true", "with \"quotes\""]), {"source", "actor", "command"}),
    (talking_system(), {"asker", "answerer"}),
    (sized_system(10), {"n0", "n1", "n2"}),
    (sized_system(140), {f"n{i}" for i in range(140 - BESIDES)})])
def test_the_systems_that_are_measured_are_sound(tmp_path, text, nodes):
    file = tmp_path / "system.toml"
    file.write_text(text)
    plan = RunPlan(system_file=str(file))
    assert set(Layout(plan, load_system(plan)).unit_of) == nodes


def test_all_nodes_are_killed_and_of_modules_one_each():
    members = members_of(CELL)
    assert usual(members) == [
        "camera", "part_finder", "motion_planner", "arm_controller", "gripper", "valve",
        "conveyor", "hmi", "cell_manager", "D_CURTAIN", "R_SAFE_TORQUE_OFF"]


def test_a_nodes_output_is_the_fastest_that_it_was_heard_on():
    members = members_of(CELL)
    manager, gripper = members["cell_manager"], members["gripper"]
    assert regular_topics(manager)[0].key == "manager/status"
    said = [Heard(0.0, key, source, 1) for key, source in (
        ("heartbeat/gripper", "gripper"), ("heartbeat/cell_manager", "cell_manager"),
        ("manager/system", "cell_manager"), ("manager/status", "cell_manager"))]
    assert output_of(manager, said) == "manager/status"
    assert output_of(gripper, said) == "heartbeat/gripper"
    assert output_of(members["camera"], said) == "heartbeat/camera"


def left_of(pid: int) -> list[int]:
    """Return the processes that a benchmark has started, and that are still there."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdecimal():
            with contextlib.suppress(OSError):
                if f"RAMPART_BENCH_OF={pid}.".encode() in (entry / "environ").read_bytes():
                    found.append(int(entry.name))
    return found


def command(*arguments: str) -> list[str]:
    return [sys.executable, "-P", "-m", "rampart.cli.main", "bench", *arguments]


@pytest.mark.processes
@pytest.mark.alone
@pytest.mark.timeout(240)
def test_the_smallest_benchmark_measures_something_of_each(tmp_path):
    out, broken = tmp_path / "out", tmp_path / "peers" / "bin" / "circusd"
    broken.parent.mkdir(parents=True)
    broken.write_text("#!/bin/sh\necho no licence\n")
    broken.chmod(0o755)
    with subprocess.Popen(command(
            *(f"--only={part}" for part in ("peers", "floors", "restart", "size")), "--kills", "2",
            *(f"--peer={name}" for name in ("dora", "circus", "subprocess", *OURS)),
            "--peers-in", str(tmp_path / "peers"),
            "--system", str(CELL), "--node", "gripper", "--sizes", "10", "--json",
            "--out", str(out)), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as done:
        stdout, stderr = done.communicate(timeout=220)
    assert (done.returncode, stderr) == (1, "")  # for two of the peers there is no figure
    found = json.loads(stdout)
    peers = {row["name"]: row for row in found["peers"]}
    assert peers["dora"]["note"] == "not installed: make bench-peers"
    assert peers["circus"]["note"] == ("circus has ended before an output of circus came; "
                                       "the last line of circus: no licence")
    for name in ("subprocess", *OURS):
        row = peers[name]
        # On a busy machine a process may be taken for hung, and be replaced.
        assert re.fullmatch(r"(replaced without a kill: \d+)?", row["note"])
        assert len(row["kills"]) == 2
        heard = [kill for kill in row["kills"] if kill["output"] is not None]
        assert row["output_ms"]["n"] == len(heard) > 0
        for kill in heard:
            assert min(kill["detected"], kill["output"]) > 0
            assert 0 < kill["begun"] < kill["output"]
    assert peers["rampart-actor"]["times"]["median"] == 1
    for floor in found["floors"]:
        assert floor["note"] == ""
        assert floor["ratio"] is None or floor["ratio"] > 0
    [gripper] = found["restart"]
    assert (gripper["title"], len(gripper["kills"])) == ("heartbeat/gripper", 2)
    [ten] = found["size"]
    assert (ten["processes"], ten["output_ms"]["n"]) == (10, len(ten["samples_ms"]))
    assert 0 < ten["uss_mb"] < ten["total_mb"]
    assert min(ten["start_s"], ten["cores"]) > 0
    assert json.loads((out / "bench.json").read_text()) == found
    assert {file.name for file in out.iterdir()} == {
        "bench.html", "bench.json", "floors.svg", "peers.svg", "restart.svg", "size.svg"}
    assert left_of(done.pid) == []


@pytest.mark.processes
@pytest.mark.alone
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_benchmark_that_is_interrupted_leaves_nothing(tmp_path, number):
    with subprocess.Popen(
            ["env", "--default-signal=HUP,INT", *command(
                "--only", "size", "--sizes", "10", "--out", str(tmp_path))],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as done:
        wait_until(lambda: len(descendants(done.pid)) > 8, 40)
        started = descendants(done.pid)
        os.kill(done.pid, number)
        _, stderr = done.communicate(timeout=30)
    assert done.returncode == 130
    assert not re.search("Traceback", stderr)
    wait_until(lambda: all(process_state(pid) in "XZ" for pid in started))
    assert list(tmp_path.iterdir()) == []
