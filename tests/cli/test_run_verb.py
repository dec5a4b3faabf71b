"""`rampart run` and `launch.py`: the same options, each under its own name and with its reports."""

import json
import os
import shutil
import socket
import subprocess
import sys

import pytest

from rampart.cli import run as launch
from rampart.cli.main import main as rampart
from rampart.cli.operate import kill_node
from rampart.cli.run_options import parse, plan_of
from rampart.testing import RealRun, free_base_port
from tests import CELL, ROOT, TANK
from tests.actors.ros2.test_gateway import SYSTEM
from tests.actors.web.pems import pair
from tests.documents.page import Page
from tests.two_hosts import two_hosts

SHORT = ["--virtual", "--system", str(CELL), "--duration", "1"]


@pytest.mark.parametrize(("start", "name"), [
    (launch.main, "launch.py"), (lambda told: rampart(["run", *told]), "rampart run")])
def test_messages_and_help_say_what_was_typed(capsys, start, name):
    assert start(["--rate", "99"]) == 2
    assert capsys.readouterr().err == f"{name}: --rate 99: must be between 0.1 and 20\n"
    with pytest.raises(SystemExit) as ended:
        start(["--help"])
    assert ended.value.code == 0
    told = capsys.readouterr().out
    assert told.startswith(f"usage: {name} ")
    assert f"  {name} --mission A --obstacles 2 " in told


def test_a_run_whose_page_would_have_another_program_s_port_is_refused(tmp_path, capsys):
    port = free_base_port()  # `free_port` is beyond the ports of a page
    with socket.create_server(("127.0.0.1", port)):
        arguments = ["--hmi-port", str(port), "--report", str(tmp_path / "report")]
        assert launch.main(arguments) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"launch.py: --hmi-port {port}: ")
    assert "Address already in use" in error
    assert not (tmp_path / "report").exists()


def test_the_verb_writes_its_report_where_one_is(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert rampart(["run", *SHORT]) == 0
    assert len([*(tmp_path / "reports").glob("*-cell/inspection-*.html")]) == 1


def test_launch_py_writes_its_report_into_its_checkout(tmp_path):
    (tmp_path / "checkout").mkdir()
    shutil.copy(ROOT / "launch.py", tmp_path / "checkout")
    done = subprocess.run(
        [sys.executable, str(tmp_path / "checkout/launch.py"), *SHORT], cwd=tmp_path,
        capture_output=True, text=True, check=False, timeout=100)
    assert done.returncode == 0, done.stderr
    assert len([*(tmp_path / "checkout/reports").glob("*-cell/inspection-*.html")]) == 1
    assert not (tmp_path / "reports").exists()


NO_OPTION = "not an option of the launcher or of tank; --system tank.toml --help lists the options"
OF_TANK, TWO = ["--system", "tank.toml"], ["--system", "two.toml"]
GROUND = [*TWO, "--host", "ground"]
OSMOSIS = ROOT / "systems/osmosis.toml"
LINK = Page("how-to/zero-velocity").block("toml").replace("guard/velocity", "summit_xl/command")
FOR_ALL = ["--hmi-host", "0.0.0.0"]
TOKEN = "secret-of-the-hangar-7"
REFUSED = [
    (["--mission", "Z"], "'Z'"),
    (["--mission", "far.miss"], "far.miss: missions.far.goals[1]: (500, 0)"),
    (["--airport", "atlantis"], "atlantis"),
    (["--airport", str(CELL)], "cell.toml: title: 'Pick and place behi"),
    (["--strategy", "hope"], "hope"),
    (["--system", "nowhere.toml"], "nowhere.toml"),
    (["--system", "/tmp"], "--system /tmp: is a directory"),
    (["--system", sys.executable], "not UTF-8 text"),
    (["--rate", "0"], "--rate 0"),
    (["--system", "osmosis-ros2", "--rate", "0.5"],
     "--rate 0.5: expected 1: node gateway exchanges messages with a robot on the wall clock, and"),
    (["--system", "link.toml", "--rate", "4"], "--rate 4: expected 1: node velocity_link"),
    (["--obstacles", "-1"], "--obstacles -1"),
    (["--port", "80"], "--port 80"),
    (["--patience", "nan"], "nan"),
    (["--duration", "5"], "--duration 5: a mission ends by itself"),
    (["--report", __file__], f"--report {__file__}: expected a directory that can be written"),
    (["--fault", "gps-bias@goal99"], "--fault gps-bias@goal99: mission AB has 5 goals"),
    (["--host", "ground"], "--host ground: osmosis has no [[host]]; it runs on one machine"),
    (["--no-keys"], "--no-keys: osmosis runs on one machine"),
    ([*OF_TANK, "--virtual"], "--virtual: expected --duration S"),
    ([*OF_TANK, "--fault", "kill:nobody"], "no node 'nobody' that a fault can hit; there are:"),
    ([*OF_TANK, "--patience", "7"], "--patience 7: tank has no mission"),
    ([*OF_TANK, "--obstacles", "1"], f"--obstacles: {NO_OPTION}"),
    *(([*OF_TANK, *page], "no node of tank serves an operator's page")
      for page in (["--wait"], ["--hmi-host", "0.0.0.0"])),
    ([*TWO, "--host", "moon", "--no-keys"], "--host moon: unknown; known: robot, ground"),
    (GROUND, "osmosis runs on 2 hosts: expected --keys DIR"),
    ([*TWO, "--no-keys", "--keys", "keys"], "--no-keys: contradicts --keys"),
    ([*GROUND, "--virtual"], "--host ground: not with --virtual"),
    *(([*GROUND, "--no-keys", option, value], f"{option} {value}: on host ground, the "
       "command line of the first host decides this")
      for option, value in (("--seed", "7"), ("--mission", "A"))),
    ([*TWO, "--no-keys", "--hmi-port", "9000"],
     "--hmi-port 9000: no node of osmosis on host the first serves an operator's page"),
    ([*TWO, "--no-keys"], "cannot listen at 192.0.2.1 port 7462 for the other hosts"),
    (["--record", "no/such/place/x.mcap"], "no/such/place/x.mcap: cannot be written"),
    (["--record", "far.miss"], "far.miss: exists already"),
    (["--overwrite"], "--overwrite: only with --record FILE"),
    (["--virtual", "--black-box"], "--black-box: not with --virtual"),
    ([*TWO, "--no-keys", "--black-box"], "--black-box: not on several hosts"),
    (["--hmi-host", "192.0.2.1", "--hmi-unencrypted"],
     "--hmi-host 192.0.2.1: expected an address of this machine"),
    (FOR_ALL, "--hmi-host 0.0.0.0: page on 0.0.0.0: has to be encrypted, because other machines "
              "can reach it: --hmi-cert FILE --hmi-key FILE; or --hmi-unencrypted"),
    ([*FOR_ALL, "--hmi-cert", "robot.crt"],
     "--hmi-cert robot.crt: contains no key; expected --hmi-key FILE, too"),
    ([*FOR_ALL, "--hmi-cert", "none"], "--hmi-cert, --hmi-key: key none: cannot be read"),
    ([*FOR_ALL, "--hmi-key", "robot.key"], "--hmi-key robot.key: expected --hmi-cert FILE, too"),
    ([*FOR_ALL, "--hmi-cert", "robot.crt", "--hmi-key", "other.key"],
     "--hmi-cert, --hmi-key: key other.key: does not fit certificate robot.crt"),
    ([*FOR_ALL, "--hmi-cert", "robot.crt", "--hmi-key", "robot.key", "--hmi-unencrypted"],
     "--hmi-unencrypted: contradicts --hmi-cert robot.crt"),
    (["--hmi-token-file", "twice"], "--hmi-token-file twice: line 2: name 'anna': there already"),
    (["--hmi-token-file", "nobody"], "--hmi-token-file nobody: is empty; rampart tokens issue"),
    (["--hmi-token-file", "bad"], "--hmi-token-file bad: token of 11 characters: "),
    (["--hmi-token-file", "far.miss"], "--hmi-token-file far.miss: mode 0644: others can access"),
    *((where, "launch.py: --hmi-token: every user of this machine can read a command line; put "
              "another token into a file of mode 0600 for --hmi-token-file FILE, or into the "
              "variable RAMPART_HMI_TOKEN")
      for where in (["--hmi-token"], ["--virtual", "--hmi-token", TOKEN])),
]


@pytest.mark.parametrize(("arguments", "words"), REFUSED, ids=[" ".join(a) for a, _ in REFUSED])
def test_bad_usage_is_one_clear_line_and_exit_code_2(
        tmp_path, monkeypatch, capfd, arguments, words):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "tank.toml").write_text(TANK)
    (tmp_path / "link.toml").write_text(f"{OSMOSIS.read_text()}\n{LINK}")
    (tmp_path / "two.toml").write_text(two_hosts({"robot": "192.0.2.1", "ground": "192.0.2.2"}))
    (tmp_path / "far.miss").write_text("x=-22,y=-18.5,taxi=1\nx=500,y=0,taxi=0\n")
    (tmp_path / "far.miss").chmod(0o644)
    pair(tmp_path, "robot")
    pair(tmp_path, "other")
    for name, text in (("twice", f"anna look {'a' * 64}\nanna look {'b' * 64}\n"),
                       ("nobody", "# nobody\n"), ("bad", "a-bad token")):
        (tmp_path / name).touch(0o600)
        (tmp_path / name).write_text(text)
    report = [] if "--report" in arguments else ["--report", str(tmp_path / "report")]
    assert launch.main([*arguments, *report]) == 2
    told = capfd.readouterr()
    assert (told.out, told.err.count("\n")) == ("", 1), told.err
    assert words in told.err
    assert not {TOKEN, "a-bad"} & set(told.err.split())
    assert not (tmp_path / "report").exists()


def test_another_rate_is_accepted_where_no_robot_is_on_the_wall_clock(tmp_path):
    simulated = tmp_path / "simulated.toml"
    simulated.write_text((ROOT / "systems/osmosis-ros2.toml").read_text().replace(
        'interfaces = ["osmosis-ros2"]',
        f'clock = "ros", interfaces = ["{ROOT / "systems/osmosis-ros2"}"]'))
    for arguments in (["--system", str(simulated)], ["--system", "osmosis-ros2", "--virtual"],
                      ["--system", "osmosis"]):
        plan, _ = plan_of(*parse([*arguments, "--rate", "0.5"], "launch.py"))
        assert plan.rate == 0.5


def test_a_bad_token_of_the_environment_is_refused_and_not_repeated(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("RAMPART_HMI_TOKEN", "short-one")
    assert launch.main(["--report", str(tmp_path / "report")]) == 2
    told = capsys.readouterr().err
    assert told.startswith("launch.py: RAMPART_HMI_TOKEN: token of 9 characters: ")
    assert "short-one" not in told


SWALLOWING = """
import os, signal
try:
    os.kill(os.getpid(), signal.SIGINT)
    sum(range(1000))
except BaseException:
    pass
from tests.actors.ros2.robot import Base
"""


@pytest.mark.processes
def test_a_module_that_swallows_an_interrupt_does_not_keep_the_run_from_ending(
        tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    (tmp_path / "own_base.py").write_text(SWALLOWING)
    (tmp_path / "own.toml").write_text(SYSTEM.replace("tests.actors.ros2.robot:Base",
                                                      "own_base:Base"))
    done = subprocess.run([sys.executable, "-m", "rampart.cli.main", "run", "--system", "own.toml",
                           "--virtual", "--duration", "1"], cwd=tmp_path, capture_output=True,
                          text=True, timeout=60, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (1, "", "")


@pytest.mark.processes
def test_a_world_is_loaded_without_glfw_which_would_start_a_process_in_the_middle_of_the_start():
    code = ("import os, sys, rampart.sim.osmosis.world; "
            "print('glfw' in sys.modules, 'MUJOCO_GL' in os.environ)")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True,
                          env={k: v for k, v in os.environ.items() if k != "MUJOCO_GL"})
    assert done.stdout == "False False\n"


@pytest.mark.processes
def test_the_web_server_is_loaded_before_the_fork_and_only_for_a_page():
    code = ("import sys; from rampart.cli.run_options import parse, plan_of\n"
            f"for more in (['--no-hmi'], ['--hmi-port', '{free_base_port()}']):\n"
            "    plan_of(*parse(more, 'run')); print('uvicorn' in sys.modules)")
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True,
                          check=True)
    assert done.stdout == "False\nTrue\n"


SICK = """
from rampart import Actor

class Sick(Actor):
    def on_start(self) -> None:
        raise RuntimeError("no sensor")
"""


@pytest.mark.processes
@pytest.mark.alone
def test_a_real_run_with_a_node_that_never_comes_up_ends_with_1_and_names_it(
        tmp_path, capsys):
    (tmp_path / "first_day_parts.py").write_text(SICK)
    nodes = "".join(f'[[node]]\nname = "{name}"\nactor = "{actor}"\nkind = "control"\n'
                    for name, actor in (("gauge", "rampart.actors.runtime.stub_node:StubNode"),
                                        ("sick", "first_day_parts:Sick")))
    (tmp_path / "day.toml").write_text(
        TANK.split("[[node]]")[0] + '[layers]\nftm = false\n[orders.safer]\n[[event]]\n'
        'name = "e"\n' + nodes)
    with RealRun(tmp_path, "day.toml", "--duration", "6") as day:
        day.sleep_until(1)
        assert kill_node.main(["gauge", "--json", "--port", str(day.port)]) == 0
        code, result = day.result()
    killed = json.loads(capsys.readouterr().out)
    assert (killed["node"], killed["signal"], killed["incarnation"]) == ("gauge", "KILL", 1)
    assert result["restarts"]["gauge"] == 1
    assert (code, result["format"], result["failing"]) == (1, 1, ["sick"])
    assert "sick fails again and again; it was restarted " in day.story
