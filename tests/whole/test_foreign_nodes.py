"""Commands as nodes, on real processes: killed, stopped, hung, flooding, forking, gone at once."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path

import pytest

from rampart.actors.foreign.keeper import LOG_BYTES, descendants
from rampart.actors.foreign.strays import find_strays
from rampart.actors.supervision.process_title import process_state
from rampart.testing import RealRun
from tests.documents.test_foreign_nodes import TUG, nodes, write_tug

pytestmark = pytest.mark.processes

FORKING = """#!/bin/sh
trap '' TERM HUP INT
setsid sh -c 'trap "" TERM; while :; do sleep 600; done' &
env -i /usr/bin/setsid /bin/sleep 601 &
(sleep 602 & )
while :; do sleep 603; done
"""
"""Ignores what it is asked, and forks: into another session, without environment, as a daemon."""

MORE = """
[supervision]
intensity = 5
period_s = 30

[[node]]
name = "forking"
command = ["./forking"]
kind = "non-control"

[[node]]
name = "flood"
command = ["yes", "nothing that anybody wants to read"]
kind = "non-control"

[[node]]
name = "quitter"
command = ["sh", "-c", "echo I quit; exit 3"]
kind = "non-control"
"""


def system_of(folder: Path, *more: str) -> None:
    """Write the tug of the page, with more nodes."""
    write_tug(folder)
    (folder / "forking").write_text(FORKING)
    (folder / "forking").chmod(0o755)
    text = TUG.replace("[[event]]", "".join(more) + "\n[[event]]")
    (folder / "tug.toml").write_text(text)


def below(tug: RealRun, node: str) -> dict[int, str]:
    """Return what runs below a node: number and command line, the keeper included."""
    pid = tug.pid(node)
    found = {}
    for one in descendants(pid) if pid else ():
        try:
            line = Path(f"/proc/{one}/cmdline").read_bytes()
        except OSError:
            continue
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
    for text in ("sleep 600", "sleep 601", "sleep 602", "sleep 603", "setsid"):
        find(tug, "forking", text if text != "setsid" else "sh -c trap")
    return list(below(tug, "forking"))


def test_what_is_killed_stopped_or_gone_comes_back_and_nothing_is_orphaned(tmp_path):
    system_of(tmp_path, MORE.partition('[[node]]\nname = "flood"')[0])
    with RealRun(tmp_path, "tug.toml") as tug:
        tug.sleep_until(0)
        folder = tug.info.folder

        os.kill(find(tug, "wheels", "wheels"), signal.SIGKILL)  # the command
        tug.wait_for("rampart: wheels #1 failed: CommandError: ./wheels ended: signal SIGKILL; "
                     "`rampart node log wheels` shows its output")
        stopped = comes_back(tug, "wheels", 2, "wheels")

        os.kill(stopped, signal.SIGSTOP)  # without its heartbeat the node has none
        comes_back(tug, "wheels", 3, "wheels")
        assert gone(stopped)

        program = tmp_path / "wheels"
        program.rename(tmp_path / "away")  # while it runs
        os.kill(find(tug, "wheels", "wheels"), signal.SIGSEGV)
        tug.wait_for(f"wheels #4 failed: CommandError: ./wheels: no such program in {tmp_path}")
        (tmp_path / "away").rename(program)

        pids = all_forked(tug)
        tug.kill("forking")  # the node
        comes_back(tug, "forking", 2, "forking")
        assert gone(*pids)

        pids = all_forked(tug)
        os.kill(find(tug, "forking", "keeper.py"), signal.SIGSTOP)
        tug.kill("forking")
        comes_back(tug, "forking", 3, "forking")
        tug.wait_until(lambda: gone(*pids), 5, "the stopped keeper left something")

        pids = all_forked(tug)
        bare = find(tug, "forking", "sleep 601")
        os.kill(find(tug, "forking", "keeper.py"), signal.SIGKILL)
        tug.wait_for("forking #3 failed: CommandError: ./forking ended: its keeper is gone")
        comes_back(tug, "forking", 4, "forking")
        assert gone(*(pid for pid in pids if pid != bare))  # which has lost keeper and environment
        os.kill(bare, signal.SIGKILL)

        pids = all_forked(tug)
        log = tug.tool("node", "log", "wheels", "--lines", "100")
        assert "wheels #1 ended: signal SIGKILL" in log.stdout
        assert "wheels #3 ended: signal SIGSEGV" in log.stdout
        none = tug.tool("node", "log", "driver")
        assert (none.returncode, none.stderr) == (1, (
            "rampart: driver: no command, or its output is not kept; there is output of: forking, "
            "wheels\n"))
        assert not list(tmp_path.rglob("errors.log"))  # what a command does is no traceback of ours
    tug.wait_until(lambda: gone(*pids) and find_strays(folder) == [], 3, "something is left")
    assert "wheels #1 ended: signal SIGKILL" in (tmp_path / "report/logs/wheels.log").read_text()


@pytest.mark.slow
def test_a_flood_and_one_that_ends_at_once_harm_nobody_and_a_killed_launcher_ends_all(tmp_path):
    system_of(tmp_path, MORE)
    with RealRun(tmp_path, "tug.toml") as tug:
        tug.sleep_until(0)
        tug.wait_for("quitter #1 failed: CommandError: sh ended: exit code 3")
        tug.wait_until(lambda: state(tug, "quitter")[0] == "given up", 20, "no end of restarts")
        quitter = state(tug, "quitter")[1]
        assert quitter >= 6
        tug.sleep_until(10)
        assert state(tug, "flood") == ("running", 1)
        assert state(tug, "wheels") == ("running", 1)
        logs = tmp_path / "report" / "logs"
        assert sum(f.stat().st_size for f in logs.glob("flood.log*")) <= 2 * LOG_BYTES
        told = tug.tool("node", "log", "flood", "--lines", "3").stdout.splitlines()
        assert len(told) == 3
        assert "bytes are left out" in (logs / "flood.log").read_text()
        assert tug.tool("node", "log", "quitter").stdout.count("I quit") >= quitter
        pids = [*all_forked(tug), *below(tug, "flood"), *below(tug, "wheels")]
        folder = tug.info.folder
        tug.process.kill()
        tug.process.wait()
        tug.wait_until(lambda: gone(*pids) and find_strays(folder) == [], 5, "something is left")
        assert not Path(folder).exists()


def test_a_topic_may_be_the_heartbeat_and_two_commands_share_a_process(tmp_path):
    write_tug(tmp_path)
    (tmp_path / "tug.toml").write_text(TUG.replace("notify = true", 'topic = "tug/wheels"').replace(
        'command = ["./wheels"]', 'command = ["./wheels"]\nprocess = "both"').replace(
        "[[event]]", """
[[node]]
name = "beside"
command = ["sleep", "604"]
kind = "control"
process = "both"

[[event]]"""))
    with RealRun(tmp_path, "tug.toml") as tug:
        tug.sleep_until(1)
        assert state(tug, "wheels") == state(tug, "beside") == ("running", 1)
        beside = find(tug, "beside", "sleep 604")
        os.kill(find(tug, "wheels", "/wheels"), signal.SIGSTOP)
        comes_back(tug, "wheels", 2, "/wheels")
        comes_back(tug, "beside", 2, "sleep 604")
        assert gone(beside)


def test_a_memory_limit_and_a_program_of_another_format_are_told(tmp_path):
    write_tug(tmp_path)
    (tmp_path / "odd").write_bytes(b"\x7fNONSENSE")
    (tmp_path / "odd").chmod(0o755)
    hungry = json.dumps(["python3", "-c", "x = bytearray(10**9)"])
    (tmp_path / "tug.toml").write_text(TUG.replace("[[event]]", f"""
[[node]]
name = "hungry"
command = {hungry}
kind = "non-control"
limits = {{ memory_mb = 300, processor_s = 5, open_files = 32, file_mb = 1 }}

[[node]]
name = "odd"
command = ["./odd"]
kind = "non-control"

[[event]]"""))
    with RealRun(tmp_path, "tug.toml", "--duration", "3") as tug:
        tug.wait_for("hungry #1 failed: CommandError: python3 ended: exit code 1")
        tug.wait_for("odd #1 failed: CommandError: ./odd cannot be started: Exec format error")
        assert "MemoryError" in tug.tool("node", "log", "hungry").stdout
