"""The folder of a run: who gets in, what is issued, and what is left behind."""

from __future__ import annotations

import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from rampart.actors.bus import run_folder

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


def test_it_leaves_room_for_the_names_of_nodes(sockets):
    name = "n" * run_folder.ROOM_FOR_NAMES
    assert run_folder.socket_path(sockets, name).endswith(name)
    with pytest.raises(ValueError, match="must be 64 characters long at most"):
        run_folder.socket_path(sockets, "n" * 108)


def test_what_was_issued_last_is_known():
    folder = run_folder.make(1, os.getpid())
    try:
        register = run_folder.register_of(folder)
        assert register("DM1") is None
        run_folder.issue(folder, ("DM1", "RM1"), 1)
        run_folder.issue(folder, ("DM1",), 12)
        assert (register("DM1"), register("RM1")) == (12, 1)
        assert run_folder.issued(folder) == {"DM1": 12, "RM1": 1}
    finally:
        run_folder.remove(folder)
    assert register("DM1") is None
    assert run_folder.issued(folder) == {}
    with pytest.raises(OSError, match="No such file"):
        run_folder.issue(folder, ("DM1",), 13)


def test_it_is_known_which_process_an_incarnation_is(sockets):
    own = os.getpid()
    run_folder.issue(sockets, ["DM1"], 3, own)
    assert run_folder.register_of(sockets)("DM1") == 3
    assert run_folder.issued(sockets) == {"DM1": 3}
    assert run_folder.is_here(sockets, "DM1")
    assert not run_folder.is_here(sockets, "DM2")
    run_folder.issue(sockets, ["DM1"], 4)  # of another machine
    assert not run_folder.is_here(sockets, "DM1")


def test_a_number_that_was_half_issued_is_issued_again(sockets):
    Path(sockets, "issued", "DM1~").symlink_to("7")  # its writer died here
    assert run_folder.issued(sockets) == {}
    run_folder.issue(sockets, ("DM1",), 8)
    assert run_folder.issued(sockets) == {"DM1": 8}


@pytest.mark.parametrize("name", ["", "..", "../issued/DM1", "a/b", "x\0", "\ud800", "n" * 5000])
def test_a_name_that_is_none_has_no_number(sockets, name):
    assert run_folder.register_of(sockets)(name) is None


def test_what_dead_runs_left_is_removed_and_what_lives_is_not(place):
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    left, other = place / f"rampart-7450-{ended.pid}-abc", place / "rampart-notes"
    left.mkdir()
    (left / "DM1").write_text("")
    other.mkdir()
    mine = run_folder.make(7450, os.getpid())
    again = run_folder.make(7451, os.getpid())
    assert not left.exists()
    assert other.exists()
    assert Path(mine).exists()
    assert Path(again).exists()


def test_a_run_lives_as_long_as_its_folder_is_locked_whatever_its_process_is_called(place):
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    of_a_container = run_folder.make(7450, ended.pid)  # here there is no such process
    left = subprocess.run([sys.executable, "-c", _MAKE, str(place), str(os.getpid())],
                          stdin=subprocess.DEVNULL, capture_output=True, text=True,
                          check=True).stdout.strip()
    assert Path(left).exists()
    run_folder.make(7452, os.getpid())
    assert Path(of_a_container).exists()
    assert not Path(left).exists()  # its process has ended; that number is another one's
    run_folder.remove(of_a_container)
    assert not Path(of_a_container).exists()


def test_what_is_forked_keeps_the_folder_of_its_run(place):
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


def test_a_link_of_that_name_is_not_followed(place, tmp_path):
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    precious = tmp_path / "precious"
    precious.mkdir()
    (precious / "thesis").write_text("done")
    (place / f"rampart-7450-{ended.pid}-abc").symlink_to(precious)
    run_folder.make(7450, os.getpid())
    assert (precious / "thesis").read_text() == "done"


def test_where_one_place_cannot_be_written_the_next_one_serves(tmp_path, monkeypatch):
    monkeypatch.setattr(run_folder, "_places", lambda: iter(["/proc", str(tmp_path)]))
    assert run_folder.make(7450, os.getpid()).startswith(str(tmp_path))
    monkeypatch.setattr(run_folder, "_places", lambda: iter(["/proc"]))
    with pytest.raises(OSError, match="/proc/rampart-7450-"):
        run_folder.make(7450, os.getpid())
