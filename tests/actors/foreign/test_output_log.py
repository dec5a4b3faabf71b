"""What is kept of the output of a command."""

from __future__ import annotations

import os
from functools import partial

import pytest

from rampart.actors.foreign import output_log
from rampart.actors.foreign.output_log import BURST_BYTES, OutputLog


@pytest.fixture
def clock(monkeypatch):
    now_s = [100.0]
    monkeypatch.setattr(output_log.time, "monotonic", lambda: now_s[0])
    return now_s


def test_output_goes_on_in_a_second_file_and_never_beyond(tmp_path, clock):
    file, before = tmp_path / "a.log", tmp_path / "a.log.1"
    file.write_bytes(b"x" * 950)
    log = OutputLog(file, most=1000)
    log.write(b"new\n" * 20)
    assert before.read_bytes() == b"x" * 950, "of the incarnation before"
    for number in range(100):
        clock[0] += 1.0
        log.write(b"%09d\n" % number * 10)
        assert file.stat().st_size <= 1000
    assert before.stat().st_size <= 1000
    assert {entry.name for entry in tmp_path.iterdir()} == {"a.log", "a.log.1"}
    assert (before.read_bytes() + file.read_bytes()).endswith(b"000000099\n")
    assert b"000000090\n" in before.read_bytes() + file.read_bytes()


def test_there_is_a_file_of_its_name_at_any_moment(tmp_path, clock, monkeypatch):
    file = tmp_path / "a.log"
    log = OutputLog(file, most=100)
    seen = []

    def watched(real, *given):
        seen.append(file.exists())
        done = real(*given)
        seen.append(file.exists())
        return done

    for name in ("unlink", "link", "replace", "open"):
        monkeypatch.setattr(output_log.os, name, partial(watched, getattr(os, name)))
    log.write(b"x" * 60)
    seen.clear()
    for _ in range(5):
        log.write(b"x" * 60)
    assert seen
    assert all(seen)


def test_a_flood_is_counted_where_it_is_too_much_and_the_count_is_told(tmp_path, clock):
    file = tmp_path / "a.log"
    log = OutputLog(file)
    for _ in range(100):
        log.write(b"x" * 65_536)
    kept = file.stat().st_size
    assert kept <= BURST_BYTES
    clock[0] += 1.0
    log.write(b"y\n")
    left_out = 100 * 65_536 - kept
    assert file.read_bytes()[kept:] == f"\n--- {left_out} bytes are left out\ny\n".encode()


def test_no_folder_and_a_link_in_the_place_of_the_log_end_nothing(tmp_path):
    OutputLog(tmp_path / "none" / "a.log").write(b"lost\n")
    target = tmp_path / "precious"
    target.write_text("mine")
    (tmp_path / "a.log").symlink_to(target)
    OutputLog(tmp_path / "a.log").write(b"lost\n")
    assert target.read_text() == "mine"
