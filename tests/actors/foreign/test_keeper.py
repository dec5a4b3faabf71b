"""What a keeper keeps of the output of a command, and how it tells its end."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
from functools import partial

import pytest

from rampart.actors.foreign import keeper
from rampart.actors.foreign.keeper import Log, in_words


@pytest.fixture
def clock(monkeypatch):
    now_s = [100.0]
    monkeypatch.setattr(keeper.time, "monotonic", lambda: now_s[0])
    return now_s


def test_a_command_whose_end_is_asked_for_before_its_start_is_not_started(tmp_path):
    order = keeper.Order("it", ["/bin/touch", str(tmp_path / "started")], "/", {}, {}, [],
                         str(tmp_path / "it.log"), 0.1)
    mine, other = socket.socketpair()
    with mine, other:
        mine.sendall(json.dumps(order._asdict()).encode() + b"\nstop\n")
        done = subprocess.run([sys.executable, "-I", "-S", keeper.__file__, str(other.fileno())],
                              pass_fds=[other.fileno()], capture_output=True, text=True,
                              timeout=20, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert not (tmp_path / "started").exists()


def test_output_goes_on_in_a_second_file_and_never_beyond(tmp_path, clock):
    file = tmp_path / "a.log"
    log = Log(str(file), most=1000)
    for number in range(100):
        clock[0] += 1.0
        log.write(b"%09d\n" % number * 10)
        assert file.stat().st_size <= 1000
    before = tmp_path / "a.log.1"
    assert before.stat().st_size <= 1000
    assert {entry.name for entry in tmp_path.iterdir()} == {"a.log", "a.log.1"}
    assert (before.read_bytes() + file.read_bytes()).endswith(b"000000099\n")
    assert b"000000085\n" in before.read_bytes() + file.read_bytes()


def test_there_is_a_file_of_its_name_at_any_moment(tmp_path, clock, monkeypatch):
    file = tmp_path / "a.log"
    log = Log(str(file), most=100)
    seen = []

    def watched(real, *given):
        seen.append(file.exists())
        done = real(*given)
        seen.append(file.exists())
        return done

    for name in ("unlink", "link", "replace", "open"):
        monkeypatch.setattr(keeper.os, name, partial(watched, getattr(os, name)))
    log.write(b"x" * 60)
    seen.clear()
    for _ in range(5):
        log.write(b"x" * 60)
    assert seen
    assert all(seen)


def test_a_flood_is_counted_where_it_is_too_much_and_the_count_is_told(tmp_path, clock):
    file = tmp_path / "a.log"
    log = Log(str(file))
    for _ in range(100):
        log.write(b"x" * 65_536)
    kept = file.stat().st_size
    assert kept <= keeper.BURST_BYTES
    clock[0] += 1.0
    log.write(b"y\n")
    left_out = 100 * 65_536 - kept
    assert file.read_bytes()[kept:] == f"\n--- {left_out} bytes are left out\ny\n".encode()


def test_the_next_incarnation_finds_room(tmp_path):
    file = tmp_path / "a.log"
    file.write_bytes(b"x" * 600)
    Log(str(file), most=1000).write(b"new\n")
    assert file.read_bytes() == b"new\n"
    assert (tmp_path / "a.log.1").read_bytes() == b"x" * 600


def test_no_folder_and_a_link_in_the_place_of_the_log_end_nothing(tmp_path):
    Log(str(tmp_path / "none" / "a.log")).write(b"lost\n")
    target = tmp_path / "precious"
    target.write_text("mine")
    (tmp_path / "a.log").symlink_to(target)
    Log(str(tmp_path / "a.log")).write(b"lost\n")
    assert target.read_text() == "mine"


@pytest.mark.parametrize(("status", "words"), [
    (0, "exit code 0"), (3 << 8, "exit code 3"), (signal.SIGSEGV, "signal SIGSEGV"),
    (signal.SIGRTMIN + 5, "signal 39")])
def test_an_end_in_words(status, words):
    assert in_words(status) == words


def test_everything_below_a_process_is_found_and_killed():
    ready, told = os.pipe()
    child = os.fork()
    if child == 0:  # a child, and one of its own in a session of its own
        if os.fork() == 0:
            os.setsid()
            os.write(told, b"x")
        signal.pause()
    os.read(ready, 1)
    try:
        found = keeper.descendants(os.getpid())
        assert child in found
        assert len(set(found) & set(keeper.descendants(child))) == 1
    finally:
        for pid in (*keeper.descendants(child), child):
            os.kill(pid, signal.SIGKILL)
        os.waitpid(child, 0)
        os.close(ready)
        os.close(told)
