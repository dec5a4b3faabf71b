"""Files of states: what a node keeps is seen, what another host sends is kept, nothing older."""

from __future__ import annotations

import errno
import queue
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from rampart.actors.hosts import state_files
from rampart.actors.hosts.state_files import LOOK_S, StateFiles
from rampart.actors.runtime.checkpoint import Record
from rampart.actors.runtime.checkpoint_file import FileCheckpoints, read
from rampart.testing import wait_until

EPOCH = 1_000_000


def record(incarnation: int, generation: int, content: bytes = b"sent") -> Record:
    return Record(incarnation, generation, 1, 0, content)


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "checkpoints"


@contextmanager
def store(folder: Path, incarnation: int = 1) -> Iterator[FileCheckpoints]:
    made = FileCheckpoints(folder, "camera", "r", incarnation)
    made.load()
    try:
        yield made
    finally:
        made.close()


class Watched:
    """The files of a camera, and the reports about them."""

    def __init__(self, folder: Path) -> None:
        self.reported: queue.SimpleQueue = queue.SimpleQueue()
        self.problems: list[tuple[str, str]] = []
        self.files = StateFiles(
            folder, "r", ["camera"],
            lambda *what: self.reported.put(what), lambda *what: self.problems.append(what))

    def next(self):
        return self.reported.get(timeout=10)


@pytest.fixture
def watched(folder):
    made = Watched(folder)
    made.files.start()
    yield made
    made.files.close()
    assert not [thread for thread in threading.enumerate() if thread.name == "states of nodes"]


def test_the_last_of_many_is_always_seen_and_no_save_is_disturbed(folder, watched):
    """Also when it comes in the moment in which the one before is read."""
    with store(folder) as made:
        made.save(1, 0, b"first")
        assert watched.next() == ("camera", record(1, 1, b"first"), False)
        for number in range(2, 400):
            made.save(1, 0, b"%d" % number * 500)
            if number % 20 == 0:
                time.sleep(LOOK_S * (number % 3))
        wait_until(lambda: watched.next()[1].generation == 399, 10, "it was not seen")
        assert made.trouble() == ""
    assert watched.problems == []


def test_what_is_sent_is_kept_and_told_as_kept_and_nothing_older_is(folder, watched):
    watched.files.settle("camera")
    assert watched.next() == ("camera", None, True)
    watched.files.take("camera", record(1, 3))
    assert watched.next() == ("camera", record(1, 3), False)
    watched.files.take("camera", record(1, 2))
    watched.files.take("camera", record(1, 4))
    assert watched.next() == ("camera", record(1, 4), False)
    watched.files.take("camera", record(EPOCH + 1, 5))
    assert watched.next() == ("camera", record(EPOCH + 1, 5), False)
    watched.files.take("camera", record(1, 500))
    watched.files.settle("camera")
    assert watched.next() == ("camera", record(EPOCH + 1, 5), True)
    assert watched.problems == []
    with store(folder, 2 * EPOCH) as made:  # the process that replaces the lost one
        made.save(1, 0, b"own")
    assert read(folder, "camera", "r").records[:2] == (
        record(2 * EPOCH, 6, b"own"), record(EPOCH + 1, 5))


def test_a_damaged_file_is_told_once_and_what_comes_after_it_is_seen(folder, watched):
    folder.mkdir()
    (folder / "camera.1.1").write_bytes(b"no state" * 999)
    wait_until(lambda: watched.problems, 10, "it was not reported")
    time.sleep(5 * LOOK_S)
    [(node, problem)] = watched.problems
    assert node == "camera"
    assert "cannot be read for another host" in problem
    with store(folder, 2) as made:
        made.save(1, 0, b"anew")
        assert watched.next() == ("camera", record(2, 1, b"anew"), False)


def test_a_state_that_cannot_be_read_in_one_moment_is_read_in_the_next(folder, monkeypatch):
    with store(folder) as made:
        made.save(1, 0, b"kept")
    looks = []

    def failing(*what):
        looks.append(what)
        if len(looks) < 4:
            raise OSError(errno.EMFILE, "Too many open files")
        return read(*what)

    monkeypatch.setattr(state_files, "read", failing)
    made = Watched(folder)
    made.files.start()
    assert made.next() == ("camera", record(1, 1, b"kept"), False)
    made.files.close()
    [(_, problem)] = made.problems
    assert "Too many open files" in problem


def test_a_place_that_cannot_be_written_is_told(folder):
    folder.write_text("a file, not a folder")
    made = Watched(folder)
    made.files.start()
    made.files.take("camera", record(1, 3))
    wait_until(lambda: any("a state of another host is not kept" in problem
                           for _, problem in made.problems), 10, "it was not reported")
    made.files.close()
