"""Checkpoints on disk: what is found again, and what every kind of damage leads to."""

import json
import os
import resource
import select
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import pytest

from rampart.actors.ftm.messages import LARGEST_STATE_BYTES
from rampart.actors.runtime import checkpoint_file
from rampart.actors.runtime.checkpoint import (
    FAILED_IN_A_ROW,
    GENERATIONS,
    RETRY_S,
    SOON_S,
    CheckpointError,
    CheckpointStore,
    Keeper,
    MemoryCheckpoints,
    Record,
    StateFormat,
    SupersededError,
)
from rampart.actors.runtime.checkpoint_file import FileCheckpoints, files_of, put, read
from rampart.testing import wait_until
from tests import ROOT

Open = Callable[[int], FileCheckpoints]


class Counter(msgspec.Struct, frozen=True):
    count: int
    step: int = 0
    label: str = "xxxx"


FORM = StateFormat(
    Counter, version=3, objection=lambda state: "it is negative" if state.count < 0 else "")


class Desk:
    """A keeper, its clock, and what it has reported."""

    def __init__(self, store: CheckpointStore, *, expected: bool = False) -> None:
        self.now_s = 0.0
        self.told: list[str] = []
        self.keeper = Keeper(store, self.told.append, lambda: self.now_s, expected=expected)

    def count(self) -> int | None:
        found = self.keeper.kept(FORM)
        return found and found.count

    def keep(self, count: int) -> None:
        self.keeper.keep(FORM, Counter(count))


@pytest.fixture
def folder(tmp_path) -> Path:
    return tmp_path / "checkpoints"


@pytest.fixture
def store(folder) -> Iterator[Open]:
    """A function that opens the store of one node for an incarnation, without its thread."""
    opened: list[FileCheckpoints] = []

    def open_for(incarnation: int) -> FileCheckpoints:
        opened.append(FileCheckpoints(folder, "node", "run", incarnation, syncs=False))
        return opened[-1]

    yield open_for
    for one in opened:
        one.close()


def states(of: FileCheckpoints) -> list[bytes]:
    return [record.state for record in of.load().records]


def counted(folder: Path) -> Path:
    """Keep six states, and return the file of the newest."""
    store = FileCheckpoints(folder, "node", "run", 1, syncs=False)
    for number in range(1, 7):
        store.save(3, 0, FORM.encode(Counter(number)))
    store.close()
    return newest(folder)


def newest(folder: Path) -> Path:
    files = files_of(folder, "node")
    return files[max(files)]


def restarted(folder: Path, incarnation: int = 2) -> tuple[int | None, list[str]]:
    """Return what the next process of the node finds and reports, having kept a state of its own.

    Whatever lies there, the one after it finds that state.
    """
    desk = Desk(FileCheckpoints(folder, "node", "run", incarnation, syncs=False), expected=True)
    found = desk.count()
    desk.keep(99)
    desk.keeper.close()
    assert newest_state(folder) == 99
    return found, desk.told


def newest_state(folder: Path) -> int:
    record, *_ = read(folder, "node", "run").records
    return FORM.decode(record.version, record.state).count


# -- what is found again -------------------------------------------------------------------------


def test_what_was_saved_is_there_for_the_next_incarnation_newest_first(store):
    first, second = store(1), store(2)
    assert first.load() == ((), ())
    for byte in b"abcdefg":
        first.save(3, 2, bytes([byte]) * LARGEST_STATE_BYTES)
    loaded = second.load()
    assert [r.state[:1] for r in loaded.records] == [b"g", b"f", b"e", b"d"][:GENERATIONS]
    assert loaded.records[0][:4] == (1, 7, 3, 2)
    assert loaded.problems == ()
    second.save(1, 0, b"b")
    assert [r.generation for r in store(3).load().records][:2] == [8, 7]


def test_a_superseded_process_overwrites_nothing_and_loads_nothing(store):
    old, new = store(1), store(2)
    old.load()
    old.save(1, 0, b"old")
    assert states(new) == [b"old"]  # it has kept nothing yet: to have loaded is enough
    old.save(1, 0, b"a ghost's")
    with pytest.raises(SupersededError):
        store(1).load()
    assert states(store(2)) == [b"old"]
    new.save(1, 0, b"new")
    old.save(1, 0, b"a ghost's")
    assert states(store(3)) == [b"new", b"old"]


def test_a_disk_that_hangs_holds_up_no_save_and_older_generations_go_when_it_has_confirmed_a_newer(
        folder, monkeypatch):
    answers, fsync = threading.Event(), os.fsync

    def slow(file: int) -> None:
        answers.wait(20)
        fsync(file)

    monkeypatch.setattr(checkpoint_file.os, "fsync", slow)
    store = FileCheckpoints(folder, "node", "run", 1)
    for number in range(60):
        store.save(1, 0, b"%d" % number)
    assert len(files_of(folder, "node")) == 60
    assert read(folder, "node", "run").records[0].state == b"59"
    answers.set()
    wait_until(lambda: len(files_of(folder, "node")) == GENERATIONS, what="older files stay")
    assert [r.state for r in read(folder, "node", "run").records] == [b"59", b"58", b"57", b"56"]
    assert store.trouble() == ""
    store.close()


def test_the_generations_of_former_processes_are_still_there_when_the_newest_is_damaged(folder):
    """Also when each process has kept one state only."""
    for incarnation in range(1, 8):
        store = FileCheckpoints(folder, "node", "run", incarnation)
        store.load()
        store.save(3, 0, FORM.encode(Counter(incarnation)))
        wait_until(lambda: len(files_of(folder, "node")) <= GENERATIONS, what="older files stay")
        store.close()
    file = newest(folder)
    file.write_bytes(file.read_bytes()[:-1])
    found, told = restarted(folder, 8)
    assert found == 6
    assert len(told) == 1


def test_a_run_starts_afresh_where_another_ended_and_takes_what_another_host_kept(folder):
    """Whatever incarnations the other run had."""
    put(folder, "node", "ended", Record(5, 40, 3, 0, FORM.encode(Counter(40))))
    found, told = restarted(folder, 1)
    assert (found, len(told)) == (None, 1)
    put(folder, "node", "run", Record(1_000_001, 5, 3, 0, FORM.encode(Counter(50))))
    assert restarted(folder, 1_000_002) == (50, [])


def test_a_folder_that_was_removed_is_made_again(store, folder):
    first = store(1)
    first.save(1, 0, b"a")
    shutil.rmtree(folder)
    first.save(1, 0, b"b")
    assert states(store(2)) == [b"b"]


def test_a_sync_that_fails_is_reported_and_the_next_state_is_kept(folder, monkeypatch):
    def fsync(_file: int) -> None:
        raise OSError(5, "Input/output error")

    store = FileCheckpoints(folder, "node", "run", 1)
    with monkeypatch.context() as patch:
        patch.setattr(checkpoint_file.os, "fsync", fsync)
        store.save(1, 0, b"a")
        wait_until(lambda: "Input/output error" in store.trouble(), what="not reported")
    store.save(1, 0, b"b")
    store.close()
    assert read(folder, "node", "run").records[0].state == b"b"


# -- damage --------------------------------------------------------------------------------------


def test_a_file_that_is_cut_or_has_a_wrong_byte_anywhere_gives_way_to_the_state_before(tmp_path):
    file = counted(tmp_path)
    whole = file.read_bytes()
    for at in range(len(whole)):
        wrong = (bytes([value]) + whole[at + 1:]
                 for value in (whole[at] ^ 1, whole[at] ^ 0x80, 255 - whole[at]))
        for rest in (b"", *wrong):
            file.write_bytes(whole[:at] + rest)
            assert newest_state(tmp_path) == 5, (at, rest)
            assert len(read(tmp_path, "node", "run").problems) == 1, (at, rest)
    found, told = restarted(tmp_path)
    assert (found, len(told)) == (5, 1)


def bind(file: Path) -> None:
    with socket.socket(socket.AF_UNIX) as bound:
        bound.bind(str(file))


def of_another(run: str, node: str) -> Callable[[Path], object]:
    def make(file: Path) -> None:
        put(file.parent, node, run, Record(1, 1, 3, 0, FORM.encode(Counter(3))))
        if node != "node":
            (file.parent / f"{node}.1.1").rename(file)

    return make


THINGS: dict[str, Callable[[Path], object]] = {
    "folder": Path.mkdir, "fifo": os.mkfifo, "socket": bind,
    "link": lambda file: file.symlink_to(counted(file.parent.parent / "elsewhere")),
    "nowhere": lambda file: file.symlink_to(file.parent / "nothing"),
    "huge": lambda file: (file.touch(), os.truncate(file, 1 << 40)),
    "another run's": of_another("other", "node"), "another node's": of_another("run", "other")}


@pytest.mark.parametrize("thing", THINGS)
def test_something_else_in_the_place_of_a_file_is_one_line_and_the_node_runs(folder, thing):
    folder.mkdir()
    THINGS[thing](folder / "node.1.1")
    begun_s = time.monotonic()
    found, told = restarted(folder)
    assert time.monotonic() - begun_s < 5
    assert found is None
    assert len(told) == 1
    assert str(folder) in told[0]
    assert "\n" not in told[0]


@pytest.mark.parametrize("make", [Path.mkdir, os.mkfifo, lambda file: file.symlink_to("/dev/full")])
def test_something_in_the_place_of_the_next_file_is_reported_and_gone_round(folder, make):
    counted(folder)
    make(folder / "node.2.7")
    desk = Desk(FileCheckpoints(folder, "node", "run", 2, syncs=False), expected=True)
    assert desk.count() == 6
    for desk.now_s in (0.0, 1.5, 3.0):
        desk.keep(99)
    desk.keeper.close()
    assert desk.told
    assert newest_state(folder) == 99


def test_a_full_disk_is_one_line_and_the_states_before_it_stay(store, folder):
    """Python ignores SIGXFSZ: writing beyond the limit fails, as on a full disk."""
    full = store(1)

    def fill() -> None:
        for number in range(100):
            full.save(1, 0, b"%04d" % number * 500 * number)

    least, most = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, most))
    try:
        with pytest.raises(CheckpointError, match=str(folder)):
            fill()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (least, most))
    full.save(1, 0, b"room again")
    records, problems = read(folder, "node", "run")
    last = 9  # the next one has more than 20,000 bytes
    assert [records[0].state, records[1].state] == [b"room again", b"%04d" % last * 500 * last]
    assert problems == ()


# -- killed in the middle ------------------------------------------------------------------------


SAVES = 20_000
"""So many that no child comes to its end."""


def state(number: int) -> bytes:
    """Return the bytes of a state; its length varies, over pages too."""
    return number.to_bytes(8, "big") + bytes([number % 251]) * (number * 37 % 9000)


def number_in(data: bytes) -> int:
    """Return the number of a state, or -1 if it is none."""
    number = int.from_bytes(data[:8], "big")
    return number if data == state(number) else -1


def live(folder: Path, acknowledge: int, start: int) -> None:
    store = FileCheckpoints(folder, "node", "run", start)
    store.load()
    for number in range(start, start + SAVES):
        store.save(1, 0, state(number))
        os.write(acknowledge, number.to_bytes(8, "big"))
    store.close()


def one(folder: Path, number: int, start: int) -> dict[str, object]:
    """Run one child until it dies, and return what it left."""
    read_end, write_end = os.pipe()
    pid = os.fork()
    if pid == 0:
        code = 1
        try:
            os.close(read_end)
            live(folder, write_end, start)
            code = 0
        finally:
            os._exit(code)
    os.close(write_end)
    if number // 500 % 3:  # two in three die while they save, the others perhaps earlier
        select.select([read_end], [], [], 10)
    due = time.monotonic() + number / 1e6
    while time.monotonic() < due:
        pass
    os.kill(pid, signal.SIGKILL)
    acknowledged = b""
    while select.select([read_end], [], []) and (data := os.read(read_end, 65536)):
        acknowledged += data
    os.close(read_end)
    _, status = os.waitpid(pid, 0)
    last = int.from_bytes(acknowledged[-8:], "big") if acknowledged else 0
    store = FileCheckpoints(folder, "node", "run", start + SAVES, syncs=False)
    loaded = store.load()
    found = number_in(loaded.records[0].state) if loaded.records else 0
    others = [number_in(record.state) for record in loaded.records]
    store.save(1, 0, state(found))  # and it works
    store.close()
    return {"is_short": status != 0, "acknowledged": last, "found": found, "kept": others}


def test_a_process_that_is_killed_at_any_time_leaves_its_last_acknowledged_state_or_the_next(
        tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", __name__, str(tmp_path), "30000",
         "500"], cwd=ROOT, capture_output=True, text=True, check=False, timeout=100)
    assert done.returncode == 0, done.stderr
    lives = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(lives) == 60
    assert sum(life["is_short"] for life in lives) >= 50
    assert len({life["acknowledged"] for life in lives}) > 10, "always killed at the same point"
    before = 0
    for index, life in enumerate(lives):
        assert -1 not in life["kept"], "a state that was never saved"
        oldest = life["acknowledged"] or (before if index % 7 else 0)
        following = life["acknowledged"] + 1 if life["acknowledged"] else 1 + 2 * SAVES * index
        assert life["found"] in (oldest, following), life
        before = life["found"]


# -- the format of states, and the keeper that stands between a store and its node


class Broken(CheckpointStore):
    """A store that fails as long as it has an error."""

    def __init__(self, error: Exception) -> None:
        self.inner = MemoryCheckpoints([], 1)
        self.error: Exception | None = error
        self.attempts = 0

    def save(self, version, failures, state):
        self.attempts += 1
        if self.error:
            raise self.error
        self.inner.save(version, failures, state)

    def load(self):
        if self.error:
            raise self.error
        return self.inner.load()


# -- the keeper ----------------------------------------------------------------------------------


def test_a_state_is_saved_once_and_the_last_generations_are_kept():
    shelf: list[Record] = []
    desk = Desk(MemoryCheckpoints(shelf, 1))
    for count in (1, 1, 2, 2, 1, *range(2, 9)):
        desk.keep(count)
    assert [r.generation for r in shelf] == [10, 9, 8, 7][:GENERATIONS]
    assert desk.told == []


def test_the_first_process_expects_nothing_and_a_later_one_reports_that_nothing_was_found():
    first, later = Desk(MemoryCheckpoints([], 1)), Desk(MemoryCheckpoints([], 2), expected=True)
    assert first.count() is None
    assert later.count() is None
    assert first.told == []
    assert later.told == ["no checkpoint was found; starting without a checkpoint"]


def test_a_state_that_makes_no_sense_gives_way_to_the_one_before_in_one_line():
    wrong = [(3, {"count": -1}), (4, {"count": 5}), (2, {"count": 5}), (3, {"count": "many"}),
             (3, [1, 2]), (3, {"step": 5}), (3, {"count": 4})]
    shelf = [Record(1, 9 - place, version, 0, msgspec.msgpack.encode(body))
             for place, (version, body) in enumerate(wrong)]
    desk = Desk(MemoryCheckpoints(shelf, 2), expected=True)
    assert desk.count() == 4
    (line,) = desk.told
    assert "\n" not in line
    assert all(f"generation {number}" in line for number in range(9, 3, -1))
    assert "version 2, expected 3" in line
    assert "it is negative" in line


def test_a_state_that_is_too_large_is_refused_with_one_line_and_the_one_before_stays():
    desk = Desk(store := MemoryCheckpoints([], 1))
    desk.keep(1)
    for tick in range(20):
        desk.now_s = float(tick)
        desk.keeper.keep(FORM, Counter(2, 0, "x" * LARGEST_STATE_BYTES))
    assert len(desk.told) == 1
    assert str(LARGEST_STATE_BYTES) in desk.told[0]
    assert Desk(store).count() == 1


def test_a_broken_store_is_tried_ever_more_rarely_and_reported_once():
    desk = Desk(store := Broken(CheckpointError("disk full")))
    assert desk.count() is None
    for tick in range(1000):
        desk.now_s = tick / 10
        desk.keep(tick)
    assert 5 < store.attempts < 10
    assert desk.told == ["disk full; starting without a checkpoint",
                         "disk full; going on without checkpoints"]
    store.error = None
    desk.now_s += RETRY_S[1]
    desk.keep(1)
    desk.keep(2)
    assert desk.told[2:] == ["checkpoints are kept again"]
    assert len(store.inner.load().records) == 2


@pytest.mark.parametrize("error", [ValueError("what no one thought of"), RecursionError("deep")])
def test_a_store_that_raises_anything_ends_no_node(error):
    desk = Desk(Broken(error), expected=True)
    assert desk.count() is None
    desk.keep(1)
    desk.keeper.failed()
    assert all(str(error) in line for line in desk.told)


def test_a_superseded_process_is_told_once_and_saves_no_more():
    store = Broken(SupersededError("incarnation 1 was superseded"))
    desk = Desk(store)
    assert desk.count() is None
    for tick in range(100):
        desk.now_s = float(tick)
        desk.keep(tick)
    assert store.attempts == 0
    assert len(desk.told) == 1


def test_a_state_with_which_processes_fail_soon_is_given_up():
    shelf: list[Record] = []
    Desk(MemoryCheckpoints(shelf, 1)).keep(13)
    for incarnation in range(2, 2 + FAILED_IN_A_ROW):
        desk = Desk(MemoryCheckpoints(shelf, incarnation))
        assert desk.count() == 13
        desk.now_s = SOON_S / 2
        desk.keeper.failed()
    last = Desk(MemoryCheckpoints(shelf, 9), expected=True)
    assert last.count() is None
    assert len(last.told) == 1
    last.keep(14)
    assert Desk(MemoryCheckpoints(shelf, 10)).count() == 14  # and the count of failures is over


def test_processes_that_fail_late_or_are_killed_do_not_count_against_the_state():
    shelf: list[Record] = []
    Desk(MemoryCheckpoints(shelf, 1)).keep(13)
    for incarnation in range(2, 20):
        desk = Desk(MemoryCheckpoints(shelf, incarnation))
        assert desk.count() is not None
        if incarnation % 3:
            desk.now_s = SOON_S * 2
            desk.keep(incarnation)
            if incarnation % 2:
                desk.keeper.failed()
        else:
            desk.keeper.failed()


def main() -> None:
    """Run children that save until something kills them, in a process without threads.

    `python -m ... DIRECTORY LAST STEP`: for each number it forks a child that saves states 1, 2,
    3, ... and acknowledges each on a pipe when `save` has returned. The parent kills the child so
    many microseconds after its start, or after its first acknowledgement. Then it opens the folder
    as a successor would, and prints one JSON line: whether the child ended early, the last state
    acknowledged, and the states found.
    """
    directory, last, step = Path(sys.argv[1]), *map(int, sys.argv[2:4])
    for index, number in enumerate(range(0, last, step)):
        # Every death is survived by the same folder; every seventh meets an empty one.
        folder = directory / str(index // 7)
        print(json.dumps(one(folder, number, 1 + 2 * SAVES * index)), flush=True)


if __name__ == "__main__":
    main()
