"""What the benchmark starts: bounded waits, and nothing left."""

from __future__ import annotations

import re
import sys
import time
from pathlib import Path

import pytest

from rampart.cli.bench import peers
from rampart.cli.bench.programs import BenchError, Program

SCRIPT = """
import subprocess, sys, time
print("\\x1b[31mbegun\\x1b[0m", flush=True)
child = subprocess.Popen([sys.executable, "-I", "-S", "-c", "import time; time.sleep(60)"],
                         start_new_session=True)
print("child", child.pid, flush=True)
time.sleep(60)
"""


def program(script, tmp_path, name="fake"):
    return Program(name, [sys.executable, "-I", "-S", "-c", script], tmp_path)


def child_of(line):
    return int(line.text.split()[1]) if line.text.startswith("child") else None


def is_there(pid):
    try:
        return "\nState:\tZ" not in Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return False


def test_all_that_a_program_has_started_ends_with_it(tmp_path):
    with program(SCRIPT, tmp_path) as running:
        child = running.wait_for(child_of, 10, "its child")
        assert running.lines[0].text == "begun"
        assert is_there(child)
        assert not running.has_ended
    assert running.has_ended
    assert not is_there(child)
    running.end()


def test_a_program_that_ignores_the_request_to_end_is_killed(tmp_path, monkeypatch):
    monkeypatch.setattr("rampart.cli.bench.programs.END_S", 0.3)
    stubborn = ("import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); "
                "print(1, flush=True); time.sleep(60)")
    with program(stubborn, tmp_path) as running:
        running.wait_for(lambda line: line.text, 10, "its line")
    assert running.has_ended


def test_who_says_nothing_is_waited_for_so_long_and_no_longer(tmp_path):
    with program("import time; print('up', flush=True); time.sleep(60)", tmp_path) as running:
        running.wait_for(lambda line: line.text, 10, "its line")
        with pytest.raises(BenchError, match=re.escape(
                "an answer did not come within 0.2 s; the last line of fake: up")):
            running.wait_for(lambda _: None, 0.2, "an answer")


def test_who_has_ended_is_not_waited_for(tmp_path):
    begun = time.monotonic()
    with program("print('no disk')", tmp_path) as running, pytest.raises(
            BenchError, match=r"fake has ended before an answer came; .*: no disk"):
        running.wait_for(lambda _: None, 60, "an answer")
    with program("import time; time.sleep(60)", tmp_path, "ear") as ear, \
            program("pass", tmp_path, "keeper") as keeper, \
            pytest.raises(BenchError, match="keeper has ended before an output came"):
        ear.wait_for(lambda _: None, 60, "an output", while_runs=keeper)
    assert time.monotonic() - begun < 60


def test_a_program_that_is_not_there_is_named(tmp_path):
    with pytest.raises(BenchError, match="fake: /no/such: No such file or directory"):
        Program("fake", ["/no/such"], tmp_path)




@pytest.mark.parametrize("peer", peers.PEERS.values(), ids=list(peers.PEERS))
def test_a_peer_is_told_to_keep_the_node_and_nothing_else(tmp_path, peer):
    node = peers.node_command(peer.name, "unixsock-stream//tmp/bus")
    command = peer.started(tmp_path, node, "/peers/bin/program")
    told = " ".join(command) + "".join(file.read_text() for file in tmp_path.iterdir())
    for word in node:
        assert word in told


@pytest.mark.parametrize(("name", "line"), [
    ("dora", "03:20:54 WARN   node: daemon restarting node after failure (attempt 1)"),
    ("supervisord", "2026-11-23 03:23:10,673 WARN exited: node (terminated by SIGKILL)"),
    ("circus", "2026-11-23 03:23:17 circus[2775] [DEBUG] reaping process 2864 [node]"),
    ("subprocess", "ended -9")])
def test_a_peers_word_that_the_node_is_gone_is_understood(name, line):
    assert peers.PEERS[name].detected.search(line)
    assert not peers.PEERS[name].detected.search("spawned: node, pid 3 success")


def test_a_peer_that_is_not_installed_is_not_started(tmp_path):
    folder = tmp_path / "dora"
    assert peers.start(peers.PEERS["dora"], folder, "bus", tmp_path / "none") is None
    assert not folder.exists()
    assert peers.version(peers.PEERS["dora"], tmp_path) == ""
