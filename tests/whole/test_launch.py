"""The product's main job on real parts: processes, Zenoh, MuJoCo, `launch.py` from the shell."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from rampart.actors.osmosis.airport.formats import load_with_truth
from rampart.actors.supervision.process_title import find_processes, process_state
from rampart.testing import RealRun, free_base_port
from tests import CELL, ROOT

pytestmark = [pytest.mark.processes, pytest.mark.alone, pytest.mark.timeout(240)]

BROKEN_A = {"A03": "out", "A06": "dim", "A10": "out"}
EVERYBODY_BUT_THE_MISSION_MANAGER = (
    "graph_planner", "osmosis_control", "localization", "hmi", "teleoperation", "safety_pilot",
    "ftm_manager", "supervisor",
    "DM1", "DM2", "DM3", "DM4", "DM5", "DM6", "DM7", "RM1", "RM2", "RM3", "RM4", "RM5")


def test_the_world_of_the_tests_is_the_one_they_think():
    truth = load_with_truth("vallombre")[1].light_factors
    assert {n for n, f in truth.items() if n.startswith("A") and f < 0.5} == set(BROKEN_A)


def near(directory: Path) -> str:
    """Write a mission whose first goal is reached after 23 s."""
    file = directory / "NEAR.miss"
    file.write_text("x=-27,y=-8,taxi=1\nx=-22,y=-18.5,taxi=1\n")
    return str(file)


@pytest.mark.slow
def test_mission_a_succeeds_although_every_other_node_is_killed_once(tmp_path):
    with RealRun(tmp_path, "paper", "--mission", "A", "--rate", "3") as run:
        run.wait_for("goal 1/3")
        start_s = 5.0
        for i, node in enumerate(EVERYBODY_BUT_THE_MISSION_MANAGER):
            run.sleep_until(start_s + 5.5 * i)
            old = run.kill(node)
            run.wait_until(lambda n=node, o=old: run.pid(n) not in {None, o}, 5,
                           f"{node} did not come back")
        code, result = run.result()
        assert (code, result["mission"], result["safety"]) == (0, "success", "safe"), run.story
        verdicts = {x["name"]: x["verdict"] for x in result["lights"] if x["row"] == "A"}
        assert {n: v for n, v in verdicts.items() if v != "ok"} == BROKEN_A
        assert len(verdicts) == 11
        assert result["restarts"] == dict.fromkeys(EVERYBODY_BUT_THE_MISSION_MANAGER, 1)
        recovered = [d for d in result["decisions"] if d["recoveries"]]
        assert {r for d in recovered for r in d["recoveries"]} == {"RM3", "RM4"}
        assert Path(result["report"]).read_text().startswith("<!")


def test_a_killed_mission_manager_loses_the_mission_and_leaves_the_robot_safe(tmp_path):
    with RealRun(tmp_path, "paper", "--mission", "A", "--rate", "3") as run:
        run.wait_for("goal 1/3")
        run.sleep_until(8)
        run.kill("mission_manager")
        code, result = run.result()
    assert (code, result["mission"], result["safety"]) == (1, "fail", "safe")
    assert any("mission lost" in reason for reason in result["reasons"])
    assert result["restarts"]["mission_manager"] == 1


def nodes_of(port: int) -> list[str]:
    """Return the names of the nodes of a run."""
    return [name for process in find_processes(port) for name in process.names
            if name not in {"pool", "run"}]


@pytest.mark.slow
def test_stopped_and_wedged_control_nodes_are_replaced_and_the_mission_goes_on(tmp_path):
    with RealRun(tmp_path, "paper", "--mission", near(tmp_path), "--rate", "2") as run:
        run.wait_for("goal 1/2")
        for at_s, number in ((6, signal.SIGSTOP), (10, signal.SIGUSR2)):  # SIGUSR2: wedge
            run.sleep_until(at_s)
            old = run.kill("osmosis_control", number)
            run.wait_until(lambda o=old: run.pid("osmosis_control") not in {None, o}, 10,
                           f"osmosis_control did not come back after {number.name}")
        before = run.story.count("goal")
        run.wait_for("goal 2/2", 60)
        assert run.story.count("goal") > before
        assert run.story.count("(RM3), block 1 for Control node crash (FTM4)") == 2


FAULTS = {
    "command-not-updated": ("DM2", {"RM2"}),
    "command-out-of-bounds": ("DM3", {"RM2"}),
    "localization-not-updated": ("DM6", {"RM5"}),
    "prohibited-area": ("DM1", {"RM1"}),
    "wrong-graph": ("DM1", {"RM1"}),
}


# With every change RM2 and RM5 in test_virtual_run.py, where real runs are compared with virtual
# ones; RM1 below, with its reset; all of them in virtual time.
@pytest.mark.slow
@pytest.mark.parametrize("fault", FAULTS)
def test_with_ftm_a_fault_leaves_the_robot_safe(tmp_path, fault):
    module, recoveries = FAULTS[fault]
    with RealRun(tmp_path, "paper", "--mission", "A", "--rate", "2", "--patience", "8") as run:
        run.wait_for("goal 1/3")
        run.sleep_until(3 if fault == "wrong-graph" else 9)
        injected = run.tool("inject", fault, "--duration", "60", "--at-once")
        assert injected.returncode == 0, injected.stderr
        code, result = run.result()
    assert (code, result["safety"]) == (1, "safe"), run.story
    assert f"{module}: " in run.story
    assert recoveries <= {r for d in result["decisions"] for r in d["recoveries"]}


def stopped_when_unsafe(run: RealRun):
    """Wait until the judge has seen enough, and end the run then."""
    run.wait_until(lambda: "UNSAFE" in run.story or run.process.poll() is not None, 100,
                   "the run did not end")
    run.process.terminate()
    return run.result()


@pytest.mark.slow
@pytest.mark.parametrize("fault", ["command-out-of-bounds", "localization-not-updated"])
def test_without_ftm_the_same_fault_is_unsafe(tmp_path, fault):
    # The others in virtual time: test_virtual_run.py.
    with RealRun(tmp_path, "paper", "--mission", "A", "--rate", "3", "--patience", "35",
                 "--no-ftm") as run:
        run.wait_for("goal 1/3")
        run.sleep_until(9)
        injected = run.tool("inject", fault, "--duration", "60", "--at-once")
        assert injected.returncode == 0, injected.stderr
        code, result = stopped_when_unsafe(run)
    assert (code, result["safety"]) == (3, "unsafe"), run.story
    assert result["decisions"] == []


@pytest.mark.slow
@pytest.mark.parametrize("node", ["localization", "osmosis_control"])
def test_without_ftm_a_killed_node_stays_dead_and_the_run_is_unsafe(tmp_path, node):
    with RealRun(tmp_path, "paper", "--mission", "A", "--rate", "3", "--patience", "35",
                 "--no-ftm") as run:
        run.wait_for("goal 1/3")
        run.sleep_until(9)
        run.kill(node)
        code, result = stopped_when_unsafe(run)
    assert (code, result["safety"]) == (3, "unsafe"), run.story
    assert result["restarts"] == {}


@pytest.mark.slow
def test_an_emergency_stop_stays_until_it_is_reset_and_then_the_mission_goes_on(tmp_path):
    with RealRun(tmp_path, "paper", "--mission", "A", "--rate", "2") as run:
        run.wait_for("goal 1/3")
        run.sleep_until(8)
        assert run.tool("inject", "prohibited-area", "--duration", "20", "--at-once"
                        ).returncode == 0
        run.wait_for("RM1")
        run.wait_for("(DM1): clear")
        time.sleep(1)
        status = json.loads(run.tool("status", "--json").stdout)
        assert "RM1" in json.dumps(status)
        assert run.tool("reset", "RM1").returncode == 0
        run.wait_for("goal 2/3", 60)


@pytest.mark.slow
def test_garbage_on_every_key_does_not_disturb_the_mission(tmp_path):
    script = (
        "import sys, zenoh, time\n"
        "from rampart.actors.osmosis import topics\n"
        "from rampart.actors.bus.zenoh_bus import session_config\n"
        "s = zenoh.open(session_config((), sys.argv[1:]))\n"
        "time.sleep(1)\n"
        "names = ['DM1', 'RM1', 'osmosis_control', 'no/such', 'x']\n"
        "for _ in range(3):\n"
        "    for t in topics.ALL:\n"
        "        for key in ([t.at(n) for n in names] if t.is_family else [t.at()]):\n"
        "            for junk in (b'', b'garbage', b'\\xff' * 300, b'\\x95\\xa1x\\x01\\x01\\xcb',\n"
        "                         b'\\x91' * 5000, b'\\x95\\xa1\\xff\\x01\\x01\\xcb' + bytes(9)):\n"
        "                s.put(key, junk)\n"
        "    time.sleep(0.2)\n"
        "s.close()\n")
    with RealRun(tmp_path, "paper", "--mission", near(tmp_path), "--rate", "2") as run:
        run.wait_for("goal 1/2")
        run.sleep_until(5)
        done = subprocess.run([sys.executable, "-c", script, *run.info.endpoints], cwd=ROOT,
                              timeout=60, check=False, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        run.wait_for("goal 2/2", 60)
        assert "payload rejected" in run.story
        assert "decision 1:" not in run.story
        assert "crashed" not in run.story


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_nothing_is_left_two_seconds_after_any_end(tmp_path, number):
    before = set(Path("/dev/shm").glob("*.zenoh")), set(Path("/tmp").glob("*rampart*"))
    with RealRun(tmp_path, "paper", "--mission", "A") as run:
        run.wait_for("goal 1/3")
        folder = Path(run.info.folder)
        assert folder.exists()
        run.process.send_signal(number)
        run.process.wait(3)
        run.wait_until(
            lambda: find_processes(run.port) == []
            and f"rampart.{run.port}." not in Path("/proc/net/unix").read_text()
            and not folder.exists(), 2, "processes or sockets were left")
    assert (set(Path("/dev/shm").glob("*.zenoh")), set(Path("/tmp").glob("*rampart*"))) == before


def test_nodes_come_back_although_root_and_watching_process_are_stopped(tmp_path):
    with RealRun(tmp_path, "osmosis", "--mission", "A") as run:
        run.wait_for("goal 1/3")
        run.sleep_until(3)
        for node in ("safety_pilot", "osmosis_control", "RM1"):
            os.kill(run.kill("run", signal.SIGSTOP), 0)
            run.process.send_signal(signal.SIGSTOP)
            run.kill(node)
            run.wait_for(f"{node} respawned")
        assert run.process.poll() is None


BAD_USAGE = [
    (["--mission", "Z"], "'Z'"),
    (["--airport", "atlantis"], "atlantis"),
    (["--strategy", "hope"], "hope"),
    (["--system", "nowhere.toml"], "nowhere.toml"),
    (["--rate", "0"], "--rate 0"),
    (["--obstacles", "-1"], "--obstacles -1"),
    (["--obstacles", "99"], "99"),
    (["--port", "80"], "--port 80"),
    (["--patience", "nan"], "nan"),
    (["--report", "/proc/x"], "--report /proc/x: no directory that can be written (No such file"),
    (["--report", __file__], f"--report {__file__}: no directory that can be written (File exists"),
    (["--system", "/tmp"], "--system /tmp: is a directory; a spec is right, or the name of a"),
    (["--system", sys.executable], f"{sys.executable}: $: not UTF-8 text"),
    (["--airport", str(CELL)], "cell.toml: title: 'Pick and place behi"),
    (["--fault", "gps-bias@goal99"], "--fault gps-bias@goal99: mission AB has 5 goals"),
]


@pytest.mark.parametrize(("arguments", "words"), BAD_USAGE, ids=[" ".join(a) for a, _ in BAD_USAGE])
def test_bad_usage_is_one_clear_line_and_exit_code_2(tmp_path, arguments, words):
    done = subprocess.run(
        [sys.executable, str(ROOT / "launch.py"), "--no-hmi", "--port", str(free_base_port()),
         "--report", str(tmp_path), *arguments],
        check=False, capture_output=True, text=True, timeout=60, cwd=tmp_path)
    assert done.returncode == 2, done.stderr
    assert words in done.stderr
    assert "Traceback" not in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1, done.stderr


def test_a_mission_point_outside_the_graph_is_refused_with_file_line_and_value(tmp_path):
    mission = tmp_path / "far.miss"
    mission.write_text("x=-22,y=-18.5,taxi=1\nx=500,y=0,taxi=0\n")
    done = subprocess.run(
        [sys.executable, str(ROOT / "launch.py"), "--no-hmi", "--mission", str(mission),
         "--port", str(free_base_port()), "--report", str(tmp_path / "r")],
        check=False, capture_output=True, text=True, timeout=60)
    assert done.returncode == 2
    assert "far.miss" in done.stderr
    assert "500" in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


def test_a_second_run_on_the_same_ports_is_refused_and_does_not_disturb_the_first(tmp_path):
    with RealRun(tmp_path, "paper", "--mission", "A", "--rate", "2") as run:
        run.wait_for("goal 1/3")
        second = subprocess.run(
            [sys.executable, str(ROOT / "launch.py"), "--no-hmi", "--port", str(run.port),
             "--report", str(tmp_path / "second")],
            check=False, capture_output=True, text=True, timeout=60)
        assert second.returncode == 2
        assert "in use" in second.stderr
        assert "Traceback" not in second.stderr
        assert len(nodes_of(run.port)) == 24
        time.sleep(2)
        assert "crashed" not in run.story


def test_ctrl_z_stops_no_run_and_a_stopped_root_is_continued(tmp_path):
    with RealRun(tmp_path, "paper", "--mission", "A") as run:
        run.wait_for("goal 1/3")
        run.process.send_signal(signal.SIGTSTP)
        run.wait_for("ctrl-Z has no effect")
        assert run.tool("status").returncode == 0
        run.process.send_signal(signal.SIGSTOP)
        assert run.tool("status").returncode == 0
        assert process_state(run.process.pid) != "T"


def test_two_runs_side_by_side_do_not_know_of_each_other(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    with RealRun(tmp_path / "a", "paper", "--mission", "A") as one:
        with RealRun(tmp_path / "b", "paper", "--mission", "A") as two:
            one.wait_for("goal 1/3")
            two.wait_for("goal 1/3")
            two.kill("DM1")
            two.wait_for("DM1 respawned")
            assert "DM1 respawned" not in one.story
            os.kill(two.process.pid, signal.SIGKILL)
            two.wait_until(lambda: find_processes(two.port) == [], 2, "processes were left")
        assert len(nodes_of(one.port)) == 24


@pytest.mark.slow
def test_the_paper_s_strategy_leaves_a_dead_node_dead_where_repair_under_guard_respawns_it(
        tmp_path):
    """The trap that `rampart verify` finds, on real processes: FTM2 and FTM4 active together."""
    stories = {}
    for strategy, shadow in (("safety-first", "guarded-repair"),
                             ("guarded-repair", "safety-first")):
        directory = tmp_path / strategy
        directory.mkdir()
        with RealRun(directory, "paper", "--mission", "A", "--rate", "2", "--strategy", strategy,
                     "--shadow", shadow) as run:
            run.wait_for("goal 1/3")
            freeze = subprocess.Popen(
                [sys.executable, "-m", "rampart.cli.main", "inject", "command-not-updated",
                  "--port",
                 str(run.port)], cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
            try:
                run.wait_for("(FTM2)")
                run.kill("osmosis_control")
                run.wait_for("(FTM2) and Control node crash (FTM4)")
                if strategy == "guarded-repair":
                    run.wait_for("nothing to recover")
                    run.wait_for("goal 2/3", 60)
                else:
                    time.sleep(3)
            finally:
                freeze.terminate()
                freeze.wait()
            stories[strategy] = run.story
    assert "RM2, block 2 for FTM2, FTM4" in stories["safety-first"]
    assert "in shadow guarded-repair would run RM2 and RM3" in stories["safety-first"]
    assert "osmosis_control respawned" not in stories["safety-first"]
    assert "RM2 and RM3, rule 2 for FTM2, FTM4" in stories["guarded-repair"]
    assert "in shadow safety-first would run RM2" in stories["guarded-repair"]


@pytest.mark.slow
def test_an_adapted_system_outlives_whatever_runs_it(tmp_path):
    def strategy() -> str:
        return str(json.loads(run.tool("status", "--json").stdout)["manager"]["strategy"])

    with RealRun(tmp_path, "paper", "--mission", "A", "--rate", "1") as run:
        run.wait_for("goal 1/3")
        before = run.pid("DM1")
        assert run.tool("adapt", "retune", "DM1", "margin_m=0.7").returncode == 0
        run.wait_until(lambda: run.pid("DM1") not in {None, before}, 5, "DM1 is not anew")
        assert run.tool("adapt", "set", "strategy", "guarded-repair").returncode == 0
        assert strategy() == "guarded-repair"
        refused = run.tool("adapt", "retune", "DM2", "timeout_s=-1")
        assert refused.returncode == 1
        assert "timeout_s" in refused.stdout + refused.stderr
        for names in (("ftm_manager",), ("supervisor",), ("ftm_manager",),
                      ("router_a", "router_b", "supervisor"), ("ftm_manager",)):
            old = {name: run.kill(name) for name in names}
            run.wait_until(lambda o=old: all(
                run.pid(n) not in {None, pid} for n, pid in o.items()), 15, f"{names} not back")
            run.wait_until(lambda: strategy() == "guarded-repair", 5, f"forgotten with {names}")
        cut = run.tool("cut-sets", "--live")
        assert cut.returncode == 0, cut.stderr
