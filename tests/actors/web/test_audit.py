"""The file that says who did what: whole after any death, bounded, and never in the way."""

from __future__ import annotations

import json
import os
from types import SimpleNamespace

import pytest

from rampart.actors.web import audit
from rampart.actors.web.audit import STRANGERS_S, AuditLog, read_audit


@pytest.fixture
def made():
    """Simulated and real time, and what was complained of."""
    return SimpleNamespace(now_s=12.3456, real_s=1000.0, told=[])


def log_in(made, file) -> AuditLog:
    return AuditLog(file, lambda: made.now_s, made.told.append, lambda: made.real_s)


@pytest.fixture
def file(tmp_path):
    return tmp_path / "audit.jsonl"


@pytest.fixture
def log(made, file) -> AuditLog:
    return log_in(made, file)


def test_a_line_says_who_when_what_and_what_came_of_it(file, log):
    log.write("reset", who="anna", address="10.0.0.7", role="drive", page=3,
              asked={"recovery": "RM1"}, why="reset of RM1 asked for")
    log.write("log in", address="10.0.0.8", refused=True, why="unknown token")
    first, second = (json.loads(line) for line in file.read_text().splitlines())
    utc = first.pop("utc")
    assert (len(utc), utc[10], utc[-6:]) == (29, "T", "+00:00")
    assert first == {"t_s": 12.346, "who": "anna", "address": "10.0.0.7", "role": "drive",
                     "page": 3, "what": "reset", "asked": {"recovery": "RM1"},
                     "outcome": "accepted",
                     "why": "reset of RM1 asked for"}
    assert second["outcome"] == "refused"
    assert [line.outcome for line in read_audit(file)] == ["accepted", "refused"]
    assert file.stat().st_mode & 0o777 == 0o600


def test_of_visitors_without_a_token_one_line_a_second_is_kept_and_the_others_counted(
        file, log, made):
    for i in range(300):
        log.write("log in", address=f"10.0.0.{i % 250}", refused=True)
        log.write("reset", who="anna")
    assert [line.who for line in read_audit(file)] == ["", *["anna"] * 300]
    made.real_s += STRANGERS_S
    log.write("log in", address="10.0.0.1", refused=True)
    assert sum(line.left_out for line in read_audit(file)) == 299


def test_a_full_file_says_so_in_its_last_line_and_grows_no_more(file, log, made, monkeypatch):
    monkeypatch.setattr(audit, "MAX_BYTES", 5000)
    for i in range(300):
        log.write("reset", who="anna", asked={"n": i})
    size = file.stat().st_size
    assert 4000 < size < 5400
    last = read_audit(file)[-1]
    assert (last.who, last.why) == ("page", "full: later actions are not recorded")
    assert made.told == [f"{file}: full: later actions are not recorded"]


def test_a_file_that_cannot_be_written_keeps_nobody_from_acting_and_is_told_once(tmp_path, made):
    file = tmp_path / "gone" / "audit.jsonl"
    log = log_in(made, file)
    for _ in range(3):
        log.write("reset", who="anna")
    assert made.told == [
        f"{file}: cannot be written (No such file or directory): actions are not recorded"]
    file.parent.mkdir()
    log.write("reset", who="anna")
    assert [(line.who, line.left_out) for line in read_audit(file)] == [("anna", 3)]


def test_a_disk_that_takes_half_a_line_loses_that_line_alone(file, log, made, monkeypatch):
    log.write("open", who="anna")
    real = os.write
    monkeypatch.setattr(audit.os, "write", lambda handle, data: real(handle, data[:20]))
    log.write("reset", who="anna")
    monkeypatch.setattr(audit.os, "write", real)
    log.write("close", who="anna")
    assert [(line.what, line.why, line.left_out) for line in read_audit(file)] == [
        ("open", "", 0), ("audit", "damaged line", 0), ("close", "", 1)]
    assert "the disk is full" in made.told[0]


def test_a_link_in_the_place_of_the_file_is_not_followed_and_without_a_file_nothing_is_kept(
        tmp_path, made):
    (tmp_path / "elsewhere").write_text("mine")
    (tmp_path / "audit.jsonl").symlink_to(tmp_path / "elsewhere")
    log_in(made, tmp_path / "audit.jsonl").write("reset", who="anna")
    assert (tmp_path / "elsewhere").read_text() == "mine"
    assert len(made.told) == 1
    log_in(made, None).write("reset")
    assert read_audit(tmp_path / "nothing") == ()


def test_a_long_request_is_kept_without_what_it_asked(file, made):
    log_in(made, file).write("order", who="anna", asked={"reason": "x" * 5000}, why="y" * 5000)
    (line,) = read_audit(file)
    assert (line.what, line.asked, len(line.why)) == ("order", {}, 500)
