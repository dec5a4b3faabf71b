"""The folder of a run: access, issued incarnations, remains of dead runs, and its postings."""

import contextlib
import os
import socket
import stat
import subprocess
import sys
import threading
from contextlib import contextmanager
from pathlib import Path

import msgspec
import pytest

from rampart.actors.bus import run_folder, run_info
from rampart.actors.bus.board import MOST_BYTES, FileBoard
from rampart.actors.bus.zenoh_bus import ZenohBus
from rampart.testing import free_base_port

_MAKE = """
import os, sys
from rampart.actors.bus import run_folder
run_folder._places = lambda: [sys.argv[1]]
print(run_folder.make(7451, int(sys.argv[2])), flush=True)
if os.fork():
    os._exit(0)
sys.stdin.read()
"""
"""Makes a folder and ends; the process that it has forked ends with its stdin."""


@pytest.fixture
def place(tmp_path, monkeypatch):
    monkeypatch.setattr(run_folder, "_places", lambda: iter([str(tmp_path)]))
    return tmp_path


def test_only_its_user_can_enter_it(sockets):
    found = Path(sockets).stat()
    assert stat.S_IMODE(found.st_mode) == 0o700
    assert found.st_uid == os.getuid()


def test_a_place_too_deep_for_a_socket_is_not_chosen(tmp_path, monkeypatch):
    deep = tmp_path / ("n" * 100)
    deep.mkdir()
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(deep))
    folder = run_folder.make(1, os.getpid())
    assert not folder.startswith(str(tmp_path))
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(f"{folder}/{run_folder.ROUTERS[0]}")
    run_folder.remove(folder)


def test_the_last_issued_incarnation_is_found_with_its_process(sockets):
    folder, register = sockets, run_folder.register_of(sockets)
    for name in ("DM1", "", "..", "../issued/DM1", "a/b", "x\0", "\ud800", "n" * 5000):
        assert register(name) is None
    Path(folder, "issued", "DM1~").symlink_to("7")  # its writer died here
    assert run_folder.issued(folder) == {}
    run_folder.issue(folder, ("DM1", "RM1"), 1)
    run_folder.issue(folder, ("DM1",), 12, os.getpid())
    assert (register("DM1"), register("RM1")) == (12, 1)
    assert run_folder.issued(folder) == {"DM1": 12, "RM1": 1}
    assert run_folder.is_here(folder, "DM1")
    assert not run_folder.is_here(folder, "DM2")
    run_folder.issue(folder, ["DM1"], 13)  # of another machine
    assert not run_folder.is_here(folder, "DM1")
    run_folder.remove(folder)
    assert register("DM1") is None
    assert run_folder.issued(folder) == {}
    with pytest.raises(OSError, match="No such file"):
        run_folder.issue(folder, ("DM1",), 14)


@pytest.fixture
def ended():
    """The id of a process that has ended."""
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


def test_folders_of_dead_runs_are_removed_and_all_others_stay(place, ended):
    left, link, other = (place / f"rampart-{one}" for one in (
        f"7450-{ended}-abc", f"7450-{ended}-def", "notes"))
    for folder in (left, other):
        folder.mkdir()
        (folder / "thesis").write_text("done")
    link.symlink_to(other)
    mine = run_folder.make(7450, os.getpid())
    again = run_folder.make(7451, os.getpid())
    assert not left.exists()
    assert (other / "thesis").read_text() == "done"
    assert Path(mine).exists()
    assert Path(again).exists()


def test_a_run_lives_as_long_as_its_folder_is_locked_whatever_its_process_is_called(place, ended):
    of_a_container = run_folder.make(7450, ended)  # here there is no such process
    left = subprocess.run([sys.executable, "-c", _MAKE, str(place), str(os.getpid())],
                          stdin=subprocess.DEVNULL, capture_output=True, text=True,
                          check=True).stdout.strip()
    assert Path(left).exists()
    run_folder.make(7452, os.getpid())
    assert Path(of_a_container).exists()
    assert not Path(left).exists()  # its process has ended; that number is another one's
    run_folder.remove(of_a_container)
    assert not Path(of_a_container).exists()


def test_a_forked_process_keeps_the_folder_of_its_run(place):
    with subprocess.Popen([sys.executable, "-c", _MAKE, str(place), "1"], text=True,
                          stdin=subprocess.PIPE, stdout=subprocess.PIPE) as maker:
        assert maker.stdout is not None
        folder = maker.stdout.readline().strip()
        assert maker.wait(10) == 0
        run_folder.make(7452, os.getpid())
        assert Path(folder).exists()


def test_several_may_issue_a_number_of_one_node_at_once(sockets):
    issue = ("import sys; from rampart.actors.bus import run_folder\n"
             "for number in range(int(sys.argv[2]), 20_000, 2): "
             "run_folder.issue(sys.argv[1], ('DM1',), number)")
    both = [subprocess.Popen([sys.executable, "-c", issue, sockets, str(first)])
            for first in (1, 2)]
    assert [one.wait(30) for one in both] == [0, 0]
    assert run_folder.issued(sockets)["DM1"] > 19_000


def test_where_one_place_cannot_be_written_the_next_one_serves(tmp_path, monkeypatch):
    monkeypatch.setattr(run_folder, "_places", lambda: iter(["/proc", str(tmp_path)]))
    assert run_folder.make(7450, os.getpid()).startswith(str(tmp_path))
    monkeypatch.setattr(run_folder, "_places", lambda: iter(["/proc"]))
    with pytest.raises(OSError, match="/proc/rampart-7450-"):
        run_folder.make(7450, os.getpid())


# -- how tools find runs, whatever else is on the machine


@contextmanager
def answering(answer: bytes):
    """Stand for a launcher that answers once; yields its base port."""
    port = free_base_port()
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as launcher:
        launcher.bind(run_info.address(port))
        launcher.listen()

        def tell() -> None:
            connection, _ = launcher.accept()
            with connection, contextlib.suppress(OSError):  # who asks need not wait
                connection.send(answer)

        teller = threading.Thread(target=tell)
        teller.start()
        yield port
        teller.join()


INFO = run_info.RunInfo(1, 7450, 1.0, 0.0, "x.toml", "", (), "r", 0, "a run")


@pytest.mark.parametrize("answer", [b"nothing", b"{}", b'{"title": "\xff"}', "another user's"])
def test_an_invalid_answer_and_a_socket_of_another_user_are_no_run(monkeypatch, answer):
    if isinstance(answer, str):
        answer = msgspec.json.encode(INFO)
        monkeypatch.setattr(run_info, "is_same_user", lambda _connection: False)
    with answering(answer) as port:
        assert run_info.ask(port) is None


def test_a_socket_whose_name_is_not_utf_8_is_ignored():
    with (answering(msgspec.json.encode(INFO)) as port,
          socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as stranger):
        stranger.bind(b"\0caf\xe9." + str(os.getpid()).encode())
        assert INFO in run_info.find_runs(), port


def test_a_base_whose_launcher_s_name_is_taken_is_not_free(monkeypatch):
    free, other = free_base_port(), free_base_port()
    monkeypatch.setattr("rampart.testing.ports._BASES", iter((free, other)))
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as launcher:
        launcher.bind(run_info.address(free))
        assert free_base_port() == other


# -- a posting is read unchanged or not at all


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
