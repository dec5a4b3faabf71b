"""Files of states: what a node keeps is seen, what another host sends is kept, nothing older."""

from __future__ import annotations

import errno
import queue
import sqlite3
import threading
import time
from contextlib import contextmanager

import pytest

from rampart.actors.hosts import state_files
from rampart.actors.hosts.state_files import LOOK_S, StateFiles
from rampart.actors.runtime.checkpoint import CheckpointError, Record, SupersededError
from rampart.actors.runtime.checkpoint_file import record_checksum
from rampart.actors.runtime.checkpoint_store import SqliteCheckpoints, newest
from rampart.testing import wait_until

EPOCH = 1_000_000


def record(incarnation: int, generation: int, content: bytes = b"sent") -> Record:
    return Record(generation, incarnation, 1, content)


@pytest.fixture
def file(tmp_path):
    return tmp_path / "checkpoints" / "camera.sqlite"


@contextmanager
def store(file, incarnation=1, run="r"):
    made = SqliteCheckpoints(file, run, incarnation, sync_period_s=0)
    try:
        yield made
    finally:
        made.close()


def states(file, incarnation):
    """Return what the next process of the node finds."""
    with store(file, incarnation) as made:
        loaded = made.load()
        assert loaded.problems == ()
        return [(*one.age, one.state) for one in loaded.records]


# ---- one file -----------------------------------------------------------------------------------


def test_a_copy_is_found_by_the_process_that_replaces_the_lost_one(file):
    with store(file, 3) as made:
        assert made.take(record(3, 7, b"a"))
        assert made.take(record(3, 9, b"b"))
    assert newest(file, "r") == record(3, 9, b"b")
    assert states(file, EPOCH + 1) == [(3, 9, b"b"), (3, 7, b"a")]


def test_what_that_process_keeps_follows_the_copy(file):
    with store(file, 3) as made:
        made.take(record(3, 7))
    with store(file, EPOCH + 1) as made:
        made.load()
        made.save(1, b"own")
    assert newest(file, "r") == Record(8, EPOCH + 1, 1, b"own")


@pytest.mark.parametrize("late", [record(3, 9), record(3, 8), record(2, 500)])
def test_the_same_or_an_older_copy_changes_nothing(file, late):
    with store(file, 3) as made:
        made.take(record(3, 9, b"newest"))
    before = file.with_name("camera.sqlite").read_bytes()
    with store(file, late.incarnation) as made:
        try:
            assert made.take(late) is False
        except SupersededError:
            assert late.incarnation < 3
    assert newest(file, "r") == record(3, 9, b"newest")
    assert late.incarnation == 3 or file.read_bytes() == before


def test_a_copy_of_a_higher_incarnation_replaces_what_has_gone_on_here_meanwhile(file):
    with store(file, 1) as made:
        made.load()
        for number in range(50):
            made.save(1, b"cut off %d" % number)
        with store(file, EPOCH + 1) as copies:
            assert copies.take(record(EPOCH + 1, 11))
        with pytest.raises(SupersededError):  # and what runs on is refused
            made.save(1, b"cut off")
    assert states(file, EPOCH + 2) == [(EPOCH + 1, 11, b"sent")]


def test_a_process_that_has_loaded_refuses_copies_of_what_came_before_it(file):
    with store(file, 1) as made:
        made.take(record(1, 5))
    with store(file, EPOCH + 1) as own:
        own.load()
        with store(file, 1) as made, pytest.raises(SupersededError):
            made.take(record(1, 6))
    assert newest(file, "r") == record(1, 5)


def test_a_process_that_loads_in_the_moment_in_which_a_copy_comes_is_not_disturbed(
        file, monkeypatch):
    with store(file, 1) as made, store(file, EPOCH + 1) as own:
        made.take(record(1, 5))
        load = made._load_and_claim

        def load_and_be_overtaken():
            found = load()
            own.load()
            return found

        monkeypatch.setattr(made, "_load_and_claim", load_and_be_overtaken)
        with pytest.raises(SupersededError):
            made.take(record(1, 6))
    assert newest(file, "r") == record(1, 5)


def test_a_copy_for_another_run_s_file_begins_anew(file):
    with store(file, 5, run="before") as made:
        made.load()
        made.save(1, b"old")
    with store(file, 1) as made:
        assert made.take(record(1, 2))
    assert states(file, 2) == [(1, 2, b"sent")]


def test_a_damaged_file_is_set_aside_and_the_copy_kept(file):
    file.parent.mkdir()
    file.write_bytes(b"garbage" * 1000)
    with store(file, 1) as made:
        assert made.take(record(1, 2))
        assert "kept as camera.damaged" in made.trouble()
    assert states(file, 2) == [(1, 2, b"sent")]


def test_where_a_copy_cannot_be_kept_what_was_there_stays(file):
    with store(file, 1) as made:
        made.take(record(1, 2))
        with sqlite3.connect(file) as other:
            other.execute("BEGIN IMMEDIATE")
            with pytest.raises(CheckpointError):
                made.take(record(1, 3))
            other.execute("ROLLBACK")
        other.close()
        assert made.take(record(1, 3))
    assert states(file, 2) == [(1, 3, b"sent"), (1, 2, b"sent")]


def test_the_states_of_a_process_whose_file_has_vanished_go_on_counting(file):
    """Else the copies of before would be newer than all that it keeps from now on."""
    with store(file, 1) as made:
        made.load()
        for _ in range(9):
            made.save(1, b"state")
        for path in file.parent.iterdir():
            path.unlink()
        made.save(1, b"after")
    assert newest(file, "r") == Record(10, 1, 1, b"after")


def test_where_there_is_no_file_there_is_no_state_and_none_is_made(file):
    assert newest(file, "r") is None
    assert not file.parent.exists()


def test_a_file_that_is_about_to_be_made_holds_no_state(file):
    file.parent.mkdir()
    file.touch()
    assert newest(file, "r") is None


# ---- the thread ---------------------------------------------------------------------------------


class Watched:
    """The files of a camera and of nothing else, and what is told of them."""

    def __init__(self, file, **nodes):
        self.told: queue.SimpleQueue = queue.SimpleQueue()
        self.problems: list[tuple[str, str]] = []
        self.files = StateFiles(
            file.parent, "r", ["camera", *nodes],
            lambda *what: self.told.put(what), lambda *what: self.problems.append(what))

    def next(self):
        return self.told.get(timeout=10)


@pytest.fixture
def watched(file):
    made = Watched(file)
    made.files.start()
    yield made
    made.files.close()
    assert not [thread for thread in threading.enumerate() if thread.name == "states of nodes"]


def test_what_a_node_keeps_is_seen_soon(file, watched):
    with store(file, 1) as made:
        made.load()
        for number in range(1, 30):
            kept_s = time.monotonic()
            made.save(1, b"%d" % number)
            assert watched.next() == ("camera", Record(number, 1, 1, b"%d" % number), False)
            assert time.monotonic() - kept_s < 2.0  # a look as a rule; the machine may be busy
    assert watched.problems == []


def test_the_last_of_many_is_always_seen(file, watched):
    """Also when it comes in the moment in which the one before is read."""
    with store(file, 1) as made:
        made.load()
        for number in range(1, 400):
            made.save(1, b"%d" % number)
            if number % 20 == 0:
                time.sleep(LOOK_S * (number % 3))
        wait_until(lambda: watched.next()[1].generation == 399, 10, "it was not seen")


def test_a_change_that_neither_time_nor_size_tell_is_seen(file, monkeypatch):
    """The kernel's clock ticks each few milliseconds, and a log is written over in place."""
    trace = ((1, 1, time.time_ns()),)
    monkeypatch.setattr(state_files, "_trace", lambda _file: trace)
    monkeypatch.setattr(state_files, "_SETTLED_S", 60.0)
    made = Watched(file)
    with store(file, 1) as node:
        node.load()
        made.files.start()
        for number in range(1, 4):
            node.save(1, b"%d" % number)
            assert made.next()[1].generation == number
    made.files.close()


def test_who_looks_keeps_no_node_from_keeping_its_state(file, watched):
    """Also while the node's own thread copies its log into the database and cuts it."""
    made = SqliteCheckpoints(file, "r", 1, sync_period_s=0.005, log_limit_bytes=20_000)
    made.load()
    for number in range(1500):
        made.save(1, b"%d" % number * 20)  # raises if it cannot
        time.sleep(0.0005)
    assert made.trouble() == ""
    made.close()
    wait_until(lambda: watched.next()[1].generation == 1500, 10, "it was not seen")
    assert watched.problems == []


def test_what_is_sent_is_kept_and_told_as_kept(file, watched):
    watched.files.take("camera", record(1, 3))
    assert watched.next() == ("camera", record(1, 3), False)
    watched.files.take("camera", record(1, 2))
    watched.files.take("camera", record(1, 4))
    assert watched.next() == ("camera", record(1, 4), False)
    watched.files.take("camera", record(EPOCH + 1, 1))
    assert watched.next() == ("camera", record(EPOCH + 1, 1), False)
    assert watched.problems == []


def test_who_asks_what_was_kept_last_is_told_in_any_case(file, watched):
    watched.files.settle("camera")
    assert watched.next() == ("camera", None, True)
    watched.files.take("camera", record(1, 3))
    assert watched.next() == ("camera", record(1, 3), False)
    watched.files.settle("camera")
    assert watched.next() == ("camera", record(1, 3), True)


def test_a_damaged_file_is_told_and_what_comes_after_it_is_seen(file, watched):
    file.parent.mkdir()
    file.write_bytes(b"no database" * 999)
    wait_until(lambda: watched.problems, 10, "it was not told")
    assert watched.problems[0][0] == "camera"
    assert "camera.sqlite cannot be read" in watched.problems[0][1]
    with store(file, 2) as made:
        made.load()
        made.save(1, b"anew")
    assert watched.next() == ("camera", Record(1, 2, 1, b"anew"), False)




def test_a_state_that_cannot_be_read_in_one_moment_is_read_in_the_next(file, monkeypatch):
    with store(file, 1) as made:
        made.load()
        made.save(1, b"kept")
    looks = []

    def read(*what):
        looks.append(what)
        if len(looks) < 4:
            raise OSError(errno.EMFILE, "Too many open files")
        return newest(*what)

    monkeypatch.setattr(state_files, "newest", read)
    made = Watched(file)
    made.files.settle("camera")
    made.files.start()
    assert made.next() == ("camera", Record(1, 1, 1, b"kept"), True)
    made.files.close()
    [(_, problem)] = made.problems
    assert "cannot be read for another host" in problem


def test_a_place_that_cannot_be_written_is_told(file):
    file.parent.parent.joinpath("checkpoints").write_text("a file, no folder")
    made = Watched(file)
    made.files.start()
    made.files.take("camera", record(1, 3))
    wait_until(lambda: made.problems, 10, "it was not told")
    assert "a state of another host is not kept" in made.problems[-1][1]
    made.files.close()


def test_a_copy_says_which_node_and_run_it_is_of():
    assert record_checksum("r camera", record(1, 1)) != record_checksum("r hmi", record(1, 1))
