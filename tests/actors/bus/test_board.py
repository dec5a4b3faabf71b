"""A posting is read unchanged or not at all."""

import os
import socket

import pytest

from rampart.actors.bus.board import MOST_BYTES, FileBoard
from rampart.actors.bus.zenoh_bus import ZenohBus

KEY = "rampart/heartbeat/a"


@pytest.fixture
def file(tmp_path):
    """Return the file of a posting that was read once."""
    FileBoard(str(tmp_path)).post(KEY, b"message")
    (file,) = tmp_path.iterdir()
    assert FileBoard(str(tmp_path)).read(KEY) == b"message"
    return file


def test_the_newest_is_read_by_another_process_of_the_host(tmp_path):
    first, second = FileBoard(str(tmp_path)), FileBoard(str(tmp_path))
    assert first.post(KEY, b"a long message")
    assert first.post(KEY, b"short")
    assert second.read(KEY) == b"short"
    assert second.post(KEY, b"of the next incarnation")
    assert first.read(KEY) == b"of the next incarnation"
    assert first.read("rampart/heartbeat/b") is None


@pytest.mark.parametrize("place", range(0, 15, 2))
def test_a_damaged_posting_counts_as_none(file, place):
    data = bytearray(file.read_bytes())
    data[place] ^= 0x10
    file.write_bytes(data)
    assert FileBoard(str(file.parent)).read(KEY) is None


@pytest.mark.parametrize("length", range(15))
def test_a_posting_whose_writer_died_counts_as_none_until_the_next(file, length):
    os.truncate(file, length)
    board = FileBoard(str(file.parent))
    assert board.read(KEY) is None
    assert board.post(KEY, b"next")
    assert board.read(KEY) == b"next"


def make_socket(file):
    with socket.socket(socket.AF_UNIX) as made:
        made.bind(str(file))


@pytest.mark.parametrize(("make", "is_writable"), [
    (os.mkdir, False), (os.mkfifo, False), (make_socket, False),
    (lambda file: file.symlink_to("/dev/zero"), False),
    (lambda file: file.write_bytes(bytes(10 * MOST_BYTES)), True)])
def test_a_file_that_is_not_a_posting_counts_as_absent_and_blocks_nothing(file, make, is_writable):
    file.unlink()
    make(file)
    board = FileBoard(str(file.parent))
    assert board.read(KEY) is None
    assert board.post(KEY, b"message") is is_writable


def test_a_posting_that_is_too_long_or_after_the_end_of_a_run_is_refused(tmp_path):
    board = FileBoard(str(tmp_path / "run"))
    assert not board.post(KEY, b"message")
    (tmp_path / "run").mkdir()
    assert board.post(KEY, bytes(MOST_BYTES))
    assert not board.post(KEY, bytes(MOST_BYTES + 1))


def test_nothing_is_posted_with_several_hosts():
    bus = ZenohBus("a", [])
    assert not bus.post(KEY, b"message")
    assert bus.posted(KEY) is None
