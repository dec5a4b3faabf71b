"""Commands as nodes, on real processes: killed, stopped, hung, flooding, forking, gone at once."""

import contextlib
import json
import os
import signal
import time
from collections.abc import Sequence
from pathlib import Path

import pytest

from rampart.actors.foreign.descendants import descendants
from rampart.actors.supervision.kill_node import signal_node
from rampart.actors.supervision.process_title import process_state
from rampart.testing import RealRun
from tests.documents.test_authors import nodes
from tests.tug import TUG, write_tug

pytestmark = pytest.mark.processes

FORKING = """#!/bin/sh
trap '' TERM HUP INT
setsid sh -c 'trap "" TERM; while :; do sleep 600; done' &
env -i /usr/bin/setsid /bin/sleep 601 &
(sleep 602 & )
while :; do sleep 603; done
"""
"""Ignores what it is asked, and forks: into another session, without environment, as a daemon."""


def node(name: str, command: Sequence[str], more: str = "") -> str:
    """Return the row of a node with a command."""
    return (f'\n[[node]]\nname = "{name}"\nkind = "non-control"\n'
            f"command = {json.dumps(command)}\n{more}\n")


def below(tug: RealRun, node: str) -> dict[int, str]:
    """Return what runs below a node: number and command line."""
    pid, found = tug.pid(node), {}
    for one in sorted(descendants(pid)) if pid else ():
        with contextlib.suppress(OSError):
            line = Path(f"/proc/{one}/cmdline").read_bytes()
            found[one] = line.replace(b"\0", b" ").decode(errors="replace").strip()
    return found


def find(tug: RealRun, node: str, text: str) -> int:
    """Wait for a process below a node and return it."""
    tug.wait_until(lambda: any(text in line for line in below(tug, node).values()), 10,
                   f"no {text} below {node}")
    return next(pid for pid, line in below(tug, node).items() if text in line)


def gone(*pids: int) -> bool:
    return all(process_state(pid) in "XZ" for pid in pids)


def state(tug: RealRun, node: str) -> tuple[str, int]:
    """Return state and incarnation."""
    return next((n["state"], n["incarnation"]) for n in nodes(tug) if n["name"] == node)


def comes_back(tug: RealRun, node: str, incarnation: int, text: str) -> int:
    """Wait until a node runs again, and return the process of its command."""
    tug.wait_until(lambda: state(tug, node) == ("running", incarnation), 20,
                   f"{node} #{incarnation} did not come")
    return find(tug, node, text)


def all_forked(tug: RealRun) -> list[int]:
    """Wait until the forking node has forked everything, and return all below it."""
    for text in ("sleep 600", "sleep 601", "sleep 602", "sleep 603", "sh -c trap"):
        find(tug, "forking", text)
    return list(below(tug, "forking"))


def write_system(folder: Path, rows: str, grace_s: float = 5.0) -> None:
    """Write the tug's system with other nodes in the place of driver and wheels."""
    write_tug(folder, compiled=False)
    head, _, rest = TUG.partition('[[node]]\nname = "driver"')
    head = head.replace("[timing]", f"[timing]\nstartup_grace_s = {grace_s}")
    (folder / "tug.toml").write_text(head + rows + rest[rest.index("[[event]]"):])


def test_what_is_killed_stopped_or_gone_comes_back_and_nothing_is_orphaned(tmp_path):
    write_tug(tmp_path)
    (tmp_path / "forking").write_text(FORKING)
    (tmp_path / "forking").chmod(0o755)
    (tmp_path / "tug.toml").write_text(
        TUG.replace("[[event]]", node("forking", ["./forking"]) + "\n[[event]]"))
    with RealRun(tmp_path, "tug.toml") as tug:
        tug.sleep_until(0)
        own = tug.pid("wheels")

        os.kill(find(tug, "wheels", "wheels"), signal.SIGKILL)  # the program
        tug.wait_for("wheels crashed, incarnation 1: ./wheels ended: signal SIGKILL; "
                     "`rampart node log wheels` shows its output")
        program = comes_back(tug, "wheels", 2, "wheels")

        os.kill(program, signal.SIGSTOP)
        tug.wait_for("wheels crashed, incarnation 2: ./wheels was stopped for 0.5 s;")
        comes_back(tug, "wheels", 3, "wheels")
        assert gone(program)

        file = tmp_path / "wheels"
        file.rename(tmp_path / "away")  # while it runs
        os.kill(find(tug, "wheels", "wheels"), signal.SIGSEGV)
        tug.wait_for(f"wheels crashed, incarnation 4: ./wheels no such program in {tmp_path};")
        (tmp_path / "away").rename(file)
        tug.wait_until(lambda: state(tug, "wheels")[0] == "running", 10, "wheels did not come")
        assert tug.pid("wheels") == own, "its process has stayed"

        incarnation = 1
        for victims in (["forking"], ["forking", "supervisor"]):
            pids = all_forked(tug)
            for victim in victims:
                tug.kill(victim)
            tug.wait_until(lambda: gone(*pids), 3, f"something is left of {victims}")  # noqa: B023
            incarnation += 1
            comes_back(tug, "forking", incarnation, "forking")

        pids = all_forked(tug)
        tug.kill("forking", signal.SIGSTOP)  # the node
        comes_back(tug, "forking", incarnation + 1, "forking")
        assert gone(*pids)

        pids = all_forked(tug)
        log = tug.tool("node", "log", "wheels", "--lines", "100")
        assert "wheels #1 ended: signal SIGKILL" in log.stdout
        assert "wheels #3 ended: signal SIGSEGV" in log.stdout
        none = tug.tool("node", "log", "driver")
        assert none.returncode == 1
        assert "nodes with output: forking, wheels" in none.stderr
        exits = [line for line in tug.story.splitlines() if "wheels" in line and "SIGKILL" in line]
        assert len(exits) == 1, exits
        assert "payload rejected" not in tug.story
        assert "Traceback" not in tug.story
        assert not list(tmp_path.rglob("errors.log"))  # what a program does is no traceback of ours
        pids += below(tug, "wheels")
        folder = Path(tug.info.folder)
        tug.process.kill()
        tug.process.wait()
        tug.wait_until(lambda: gone(*pids) and not folder.exists(), 5, "something is left")
    assert "wheels #1 ended: signal SIGKILL" in (tmp_path / "report/logs/wheels.log").read_text()


def test_a_signal_that_stops_a_command_reaches_its_program_and_what_that_has_forked(tmp_path):
    write_system(tmp_path, "".join(
        node(name, ["sh", "-c", f"sleep 606; echo {name}"], 'process = "both"')
        for name in ("first", "second")))
    with RealRun(tmp_path, "tug.toml") as tug:
        tug.sleep_until(0.5)
        own, first = tug.pid("first"), find(tug, "first", "echo first")
        second = find(tug, "second", "echo second")
        asleep = {pid for pid, line in below(tug, "first").items() if line == "sleep 606"}
        assert signal_node("first", "STOP", tug.port).pid == first

        def stopped():
            return {pid for pid in (first, second, own, *asleep) if process_state(pid) == "T"}

        tug.wait_until(lambda: len(stopped()) == 2, 2, "not stopped")
        assert stopped() - asleep == {first}
        signal_node("first", "CONT", tug.port)
        tug.wait_until(lambda: not stopped(), 2, "not continued")
        assert tug.pid("first") == signal_node("first", "KILL", tug.port).pid
        comes_back(tug, "first", 2, "echo first")
        comes_back(tug, "second", 2, "echo second")  # of the same process
        assert gone(second)


CARRIER = """
from rampart import Actor, Message, Qos, Topic, every


class Alive(Message):
    pass


ALIVE = Topic("sleeper/alive", Alive, Qos.SENSOR, 20.0, "", "The sleeper works.")


class Carrier(Actor):
    outputs = (ALIVE,)

    def on_start(self):
        self.began_s = self.clock.now()

    @every(0.05)
    def carry(self):
        if self.clock.now() > self.began_s + 1.0 and self.context.incarnation < 3:
            self.publish(ALIVE, Alive())
"""
"""Publishes from a second after its start on; the third incarnation publishes nothing."""


def test_a_program_is_not_blamed_while_the_node_that_publishes_its_heartbeat_restarts(tmp_path):
    (tmp_path / "carrier.py").write_text(CARRIER)
    write_system(tmp_path, """
[[node]]
name = "carrier"
actor = "carrier:Carrier"
kind = "non-control"
""" + node("sleeper", ["sleep", "605"],
           'heartbeat = { key = "sleeper/alive", timeout_s = 0.5 }'), 2.5)
    with RealRun(tmp_path, "tug.toml") as tug:
        tug.sleep_until(2)
        tug.kill("carrier")
        tug.wait_until(lambda: state(tug, "carrier") == ("running", 2), 10, "no new carrier")
        time.sleep(1.5)
        assert state(tug, "sleeper") == ("running", 1)
        tug.kill("carrier")
        tug.wait_for("sleeper crashed, incarnation 1: sleep hung: no heartbeat for 2.5 s after its "
                     "start or that of carrier, which publishes sleeper/alive;", 10)


PROGRAM = """
import os, signal, socket, sys, time

notify = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)

def tell(what):
    notify.sendto(what.encode(), "\\0" + os.environ["NOTIFY_SOCKET"][1:])

def beat(seconds):
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        tell("WATCHDOG=1")
        time.sleep(0.05)

first = os.environ["RAMPART_INCARNATION"] == "1"
how = sys.argv[1]
tell("READY=1\\nSTATUS=up and well")
if first and how == "its child beats":
    beat(0.5)
    if os.fork() == 0:
        beat(600)
    os.kill(os.getpid(), signal.SIGSTOP)
if first and how == "says that it ends":
    tell("STOPPING=1")
    beat(600)
if first and how == "needs time":
    tell("EXTEND_TIMEOUT_USEC=000000000000003000000")
    time.sleep(2.0)
    beat(0.5)
    time.sleep(600)
beat(600)
"""


def test_what_sd_notify_says_is_taken_as_it_is_documented(tmp_path):
    (tmp_path / "program.py").write_text(PROGRAM)
    spoken = {"child": "its child beats", "stopping": "says that it ends", "slow": "needs time"}
    commands = {name: ["python3", "program.py", how] for name, how in spoken.items()}
    commands["cold"] = ["sh", "-c", "echo x >> starts; sleep 9"]
    write_system(tmp_path, "".join(
        node(name, command, "heartbeat = { notify = true, timeout_s = 1.0 }")
        for name, command in commands.items()), 2.5)
    with RealRun(tmp_path, "tug.toml") as tug:
        tug.wait_for("child crashed, incarnation 1: python3 was stopped for 1 s;")
        tug.wait_for("stopping crashed, incarnation 1: python3 hung: no heartbeat for 1 s;")
        tug.wait_for("cold crashed, incarnation 2: sh hung: no heartbeat for 2.5 s after its "
                     "start; a larger startup_grace_s in [timing] gives it more time;")
        tug.wait_for("slow crashed, incarnation 1: python3 hung: no heartbeat for 1 s;")
        for name in spoken:
            comes_back(tug, name, 2, "program.py")
        (cold,) = (row for row in nodes(tug) if row["name"] == "cold")
        assert cold["restarts"] == cold["incarnation"] - 1 >= 1
        assert len((tmp_path / "starts").read_text().split()) >= 2
        assert "STATUS=up and well" in tug.tool("node", "log", "slow").stdout


def test_a_program_that_may_end_stays_ended_one_that_fails_is_restarted_and_a_limit_is_kept(
        tmp_path):
    write_system(
        tmp_path,
        node("calibration", ["sh", "-c", "echo $RAMPART_INCARNATION >> calibrated"],
             "may_end = true")
        + node("failing", ["sh", "-c", "[ $RAMPART_INCARNATION -gt 2 ]"], "may_end = true")
        + node("hungry", ["python3", "-c", "x = bytearray(10**9)"],
               "limits = { memory_mb = 300, processor_s = 5, open_files = 32, file_mb = 1 }"))
    with RealRun(tmp_path, "tug.toml", "--duration", "30") as tug:
        tug.sleep_until(1)
        tug.wait_until(lambda: state(tug, "failing") == ("running", 3), 20, "it was not restarted")
        tug.wait_for(": python3 ended: exit code 1;")
        assert "MemoryError" in tug.tool("node", "log", "hungry").stdout
        tug.sleep_until(6)
        assert state(tug, "calibration") == ("running", 1)
        assert state(tug, "failing") == ("running", 3)
        assert below(tug, "calibration") == below(tug, "failing") == {}
        old = tug.kill("calibration")
        tug.wait_until(lambda: tug.pid("calibration") not in {None, old}, 10, "not replaced")
        tug.wait_until(lambda: (tmp_path / "calibrated").read_text().split() == ["1", "2"], 10,
                       "it did not run again")
