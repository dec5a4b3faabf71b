"""Checkpoints: what is kept, what is found again, and what every kind of damage leads to."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rampart.actors.runtime.checkpoint import (
    BUSY_TIMES,
    FAILED_IN_A_ROW,
    GENERATIONS,
    RETRY_S,
    SOON_S,
    BusyError,
    CheckpointError,
    CheckpointStore,
    Keeper,
    MemoryCheckpoints,
    NoCheckpoints,
    Record,
    Shelf,
    StateError,
    StateFormat,
    SupersededError,
    newest_sound,
)
from rampart.actors.runtime.checkpoint_file import APPLICATION, LARGEST_STATE_BYTES, STORE_FORMAT
from rampart.actors.runtime.checkpoint_store import SqliteCheckpoints
from tests import ROOT
from tests.actors.runtime.checkpoint_crasher import SAVES

Open = Callable[[int], CheckpointStore]


@pytest.fixture(params=["sqlite", "memory"])
def open_store(request, tmp_path) -> Iterator[Open]:
    """A function that opens the store of one node for an incarnation."""
    shelf, opened = Shelf(), []

    def open_for(incarnation: int) -> CheckpointStore:
        store = (MemoryCheckpoints(shelf, incarnation) if request.param == "memory" else
                 SqliteCheckpoints(tmp_path / "checkpoints" / "n.sqlite", "run", incarnation))
        opened.append(store)
        return store

    yield open_for
    for store in opened:
        store.close()


@pytest.fixture
def file(tmp_path) -> Path:
    return tmp_path / "checkpoints" / "node.sqlite"


@pytest.fixture
def sqlite_store(file) -> Iterator[Open]:
    """The same for SQLite alone, without its thread."""
    opened: list[SqliteCheckpoints] = []

    def open_for(incarnation: int) -> SqliteCheckpoints:
        opened.append(SqliteCheckpoints(file, "run", incarnation, sync_period_s=0))
        return opened[-1]

    yield open_for
    for store in opened:
        store.close()


def states(store: CheckpointStore) -> list[bytes]:
    return [record.state for record in store.load().records]


def edit(file: Path, statement: str, *values: object) -> None:
    with sqlite3.connect(file) as connection:
        connection.execute(statement, values)
    connection.close()


# -- both stores ---------------------------------------------------------------------------------


def test_an_empty_store_has_nothing(open_store):
    loaded = open_store(1).load()
    assert (loaded.records, loaded.problems, loaded.failures) == ((), (), 0)


def test_what_was_saved_is_there_for_the_next_incarnation_newest_first(open_store):
    first = open_store(1)
    for number in range(7):
        first.save(3, b"state %d" % number)
    records = open_store(2).load().records
    assert [r.state for r in records] == [b"state %d" % n for n in (6, 5, 4, 3)][:GENERATIONS]
    newest = records[0]
    assert (newest.generation, newest.incarnation, newest.version) == (7, 1, 3)


def test_generations_go_on_counting_in_the_next_life(open_store):
    open_store(1).save(1, b"a")
    second = open_store(2)
    second.load()
    second.save(1, b"b")
    assert [r.generation for r in open_store(3).load().records] == [2, 1]


def test_a_superseded_incarnation_can_neither_save_nor_load(open_store):
    old, new = open_store(1), open_store(2)
    old.load()
    old.save(1, b"old")
    new.load()  # has saved nothing yet: the claim is enough
    with pytest.raises(SupersededError, match="incarnation 1 was superseded"):
        old.save(1, b"a ghost's")
    with pytest.raises(SupersededError):
        open_store(1).load()
    assert states(open_store(2)) == [b"old"]


def test_failures_are_kept(open_store):
    first = open_store(1)
    first.load()
    first.note_failures(2)
    assert open_store(2).load().failures == 2


def test_a_store_that_keeps_nothing_keeps_nothing():
    store = NoCheckpoints()
    store.save(1, b"x")
    store.note_failures(3)
    assert store.load().records == ()


# -- formats -------------------------------------------------------------------------------------


class Counter(msgspec.Struct, frozen=True):
    """Version 3: `count` was called `n` in version 1, and had no `step` before version 3."""

    count: int
    step: int
    label: str = ""


COUNTER = StateFormat(
    Counter, version=3,
    upgrades={1: lambda old: {"count": old["n"]}, 2: lambda old: {**old, "step": 1}},
    objection=lambda state: "it is negative" if state.count < 0 else "")


def record(version: int, body: object, generation: int = 1) -> Record:
    return Record(generation, 1, version, msgspec.msgpack.encode(body))


@given(st.integers(0, 2**40), st.integers(), st.text())
def test_a_state_survives_encoding(count, step, label):
    state = Counter(count, step % 1000, label)
    assert COUNTER.decode(3, COUNTER.encode(state)) == state


@pytest.mark.parametrize(("version", "body"), [(1, {"n": 5}), (2, {"count": 5}),
                                               (3, {"count": 5, "step": 1})])
def test_older_versions_are_upgraded_step_by_step(version, body):
    assert COUNTER.decode(version, msgspec.msgpack.encode(body)) == Counter(5, 1)


@pytest.mark.parametrize(("version", "body", "why"), [
    (4, {"count": 5, "step": 1}, "version 4 is newer than this program's 3"),
    (0, {"n": 5}, "version 0 is too old for this program's 3"),
    (3, {"count": "many", "step": 1}, "no Counter: ValidationError"),
    (1, {"m": 5}, "no Counter: KeyError: 'n'"),
    (3, {"count": -1, "step": 1}, "a Counter that makes no sense: it is negative"),
    (2, [1, 2], "no Counter: ValidationError"),
])
def test_a_state_that_cannot_be_used_is_refused_in_one_line(version, body, why):
    with pytest.raises(StateError) as refused:
        COUNTER.decode(version, msgspec.msgpack.encode(body))
    assert why in str(refused.value)
    assert "\n" not in str(refused.value)


@given(st.binary(max_size=60), st.integers(0, 5))
def test_no_bytes_whatever_do_more_than_be_refused(data, version):
    with contextlib.suppress(StateError):
        assert isinstance(COUNTER.decode(version, data), Counter)


def test_the_newest_sound_state_is_taken_and_the_others_are_named():
    records = (record(4, {}, 9), record(3, {"count": -1, "step": 0}, 8), record(1, {"n": 7}, 7),
               record(1, {"n": 6}, 6))
    state, problems = newest_sound(COUNTER, records)
    assert state == Counter(7, 1)
    assert [p.split(":")[0] for p in problems] == ["generation 9", "generation 8"]
    assert newest_sound(COUNTER, records[:2])[0] is None


# -- damage to the file --------------------------------------------------------------------------


def saved(sqlite_store, count: int = 6) -> None:
    store = sqlite_store(1)
    for number in range(1, count + 1):
        store.save(1, b"state %d " % number * 200)
    store.close()


@pytest.mark.parametrize("column", ["state", "checksum", "generation", "version", "incarnation"])
def test_a_record_with_a_wrong_checksum_gives_way_to_the_one_before(sqlite_store, file, column):
    saved(sqlite_store)
    value = b"torn" if column in ("state", "checksum") else 99
    edit(file, f"UPDATE checkpoint SET {column} = ? WHERE generation = 6", value)
    loaded = sqlite_store(2).load()
    assert [r.generation for r in loaded.records] == [5, 4, 3]
    assert len(loaded.problems) == 1
    assert "checksum is wrong" in loaded.problems[0]


def test_a_value_of_a_wrong_type_is_damage_as_well(sqlite_store, file):
    saved(sqlite_store)
    edit(file, "UPDATE checkpoint SET state = 'text' WHERE generation = 6")
    assert [r.generation for r in sqlite_store(2).load().records] == [5, 4, 3]


@pytest.mark.parametrize("content", [b"", b"no database" * 500,
                                     b"SQLite format 3\0" + b"\xff" * 900])
def test_a_file_that_is_no_database_is_set_aside_and_begun_anew(sqlite_store, file, content):
    file.parent.mkdir()
    file.write_bytes(content)
    store = sqlite_store(2)
    loaded = store.load()
    assert loaded.records == ()
    if content:
        assert "node.damaged" in loaded.problems[0]
        assert file.with_suffix(".damaged").read_bytes() == content
    store.save(1, b"new")
    assert states(sqlite_store(3)) == [b"new"]


def test_overwritten_pages_cost_the_states_on_them_and_nothing_else(sqlite_store, file):
    saved(sqlite_store)
    original, outcomes = file.read_bytes(), set()
    for start in range(0, len(original), 1024):
        damaged = bytearray(original)
        damaged[start:start + 1024] = b"\xa5" * 1024
        file.write_bytes(damaged)
        store = sqlite_store(2)
        loaded = store.load()
        for kept in loaded.records:  # what is found is what was saved, whatever was damaged
            assert kept.state == b"state %d " % kept.generation * 200
        store.save(1, b"goes on")
        assert states(sqlite_store(2))[0] == b"goes on"
        outcomes.add(len(loaded.records))
        for path in file.parent.iterdir():
            path.unlink()
    assert 0 in outcomes
    assert max(outcomes) >= 3


def test_a_torn_log_costs_the_states_in_its_tail(sqlite_store, file, tmp_path):
    store = sqlite_store(1)
    for number in range(1, 5):
        store.save(1, b"state %d " % number * 200)
    copy = tmp_path / "copy"
    shutil.copytree(file.parent, copy)  # as a process finds it that comes after a SIGKILL
    log = copy / "node.sqlite-wal"
    whole, seen = log.read_bytes(), []
    for size in range(len(whole), -1, -1000):
        log.write_bytes(whole[:size])
        (copy / "node.sqlite-shm").unlink(missing_ok=True)
        probe = SqliteCheckpoints(copy / "node.sqlite", "run", 1, sync_period_s=0)
        records = probe.load().records
        probe.close()
        seen.append(records[0].generation if records else 0)
        for path in copy.iterdir():
            path.unlink()
        for path in file.parent.iterdir():
            shutil.copy(path, copy)
    assert seen == sorted(seen, reverse=True)
    assert seen[0] == 4
    assert {3, 2, 1} & set(seen)


def test_the_states_of_another_run_are_not_taken(tmp_path):
    file = tmp_path / "node.sqlite"
    for run, incarnation in (("first", 7), ("second", 1)):
        store = SqliteCheckpoints(file, run, incarnation, sync_period_s=0)
        assert store.load().records == ()
        store.save(1, run.encode())
        store.close()
    store = SqliteCheckpoints(file, "second", 2, sync_period_s=0)
    assert states(store) == [b"second"]
    store.close()


def test_the_file_says_what_it_is(sqlite_store, file):
    saved(sqlite_store)
    connection = sqlite3.connect(file)
    assert connection.execute("PRAGMA application_id").fetchone() == (APPLICATION,)
    assert connection.execute("PRAGMA user_version").fetchone() == (STORE_FORMAT,)
    connection.close()


# -- trouble with the disk -----------------------------------------------------------------------


def test_a_directory_that_vanishes_is_made_again_and_said(sqlite_store, file):
    store = sqlite_store(1)
    store.save(1, b"one")
    shutil.rmtree(file.parent)
    store.save(1, b"two")
    assert "has vanished; begun anew" in store.trouble()
    assert store.trouble() == ""
    assert states(sqlite_store(2)) == [b"two"]


def test_where_no_directory_can_be_is_one_line(tmp_path):
    (tmp_path / "file").write_text("in the way")
    store = SqliteCheckpoints(tmp_path / "file" / "checkpoints" / "n.sqlite", "run", 1)
    with pytest.raises(CheckpointError, match="Not a directory"):
        store.load()
    with pytest.raises(CheckpointError, match="Not a directory"):
        store.save(1, b"x")


@contextlib.contextmanager
def locked(file: Path) -> Iterator[None]:
    stale = sqlite3.connect(file, isolation_level=None)
    stale.execute("BEGIN IMMEDIATE")
    try:
        yield
    finally:
        stale.execute("ROLLBACK")
        stale.close()


def test_a_lock_that_somebody_holds_is_not_waited_for(sqlite_store, file):
    saved(sqlite_store)
    store = sqlite_store(2)
    with locked(file), pytest.raises(BusyError, match="database is locked"):
        store.save(1, b"x")
    store.save(1, b"after")
    assert states(sqlite_store(3))[0] == b"after"


def test_what_was_kept_is_found_though_somebody_holds_the_lock_while_it_is_looked_for(
        sqlite_store, file):
    first = Desk(sqlite_store(1))
    first.keeper.keep(COUNTER, Counter(7, 0))
    first.keeper.close()
    second = Desk(sqlite_store(2), expected=True)
    with locked(file):
        assert second.keeper.kept(COUNTER) == Counter(7, 0)
    second.keeper.keep(COUNTER, Counter(8, 0))
    assert second.told == []
    assert Desk(sqlite_store(3)).keeper.kept(COUNTER) == Counter(8, 0)


def test_a_life_that_could_not_claim_does_so_with_its_first_save_and_older_ones_are_refused(
        sqlite_store, file):
    old, new = sqlite_store(1), sqlite_store(2)
    old.save(1, b"old")
    with locked(file):
        assert states(new) == [b"old"]
    for _ in range(GENERATIONS):
        old.save(1, b"a ghost's")  # as long as nothing of its successor's is there
    new.save(1, b"new")
    with pytest.raises(SupersededError):
        old.save(1, b"a ghost's, too late")
    assert states(sqlite_store(3))[0] == b"new"


def test_a_superseded_life_finds_nothing_though_the_lock_keeps_it_from_claiming(
        sqlite_store, file):
    sqlite_store(2).save(1, b"new")
    old = sqlite_store(1)
    with locked(file), pytest.raises(SupersededError):
        old.load()
    with pytest.raises(SupersededError):
        old.save(1, b"a ghost's")
    assert states(sqlite_store(2)) == [b"new"]


def test_the_failures_of_former_lives_are_known_though_the_lock_keeps_one_from_claiming(
        sqlite_store, file):
    first = sqlite_store(1)
    first.save(1, b"bad")
    first.note_failures(2)
    second = sqlite_store(2)
    with locked(file):
        assert second.load().failures == 2
    second.note_failures(3)
    assert sqlite_store(3).load().failures == 3


IN_A_PROCESS = """
import os, resource, sys
from pathlib import Path
from rampart.actors.runtime.checkpoint import CheckpointError
from rampart.actors.runtime.checkpoint_store import SqliteCheckpoints
file, what = Path(sys.argv[1]), sys.argv[2]
store = SqliteCheckpoints(file, "run", 1, sync_period_s=0)
if what == "full":  # python ignores SIGXFSZ: writing beyond the limit fails, as on a full disk
    store.save(1, b"before " * 100)
    resource.setrlimit(resource.RLIMIT_FSIZE, (90_000, resource.RLIM_INFINITY))
    saved, error = 0, ""
    while not error and saved < 100:
        try:
            store.save(1, b"%04d" % saved * 500)
            saved += 1
        except CheckpointError as problem:
            error = str(problem)
    print(saved, error)
    resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    store.save(1, b"room again")
    store.close()
elif what == "full at load":
    resource.setrlimit(resource.RLIMIT_FSIZE, (33_000, resource.RLIM_INFINITY))  # the log is larger
    print(store.load().records[0].state.decode())
    try:
        store.save(1, b"x")
    except CheckpointError as problem:
        print(problem)
else:
    if os.getuid() == 0:
        os.setuid(65534)
    for action in (store.load, lambda: store.save(1, b"x")):
        try:
            action()
            print("worked")
        except CheckpointError as problem:
            print(problem)
"""


def in_a_process(file: Path, what: str) -> list[str]:
    done = subprocess.run([sys.executable, "-c", IN_A_PROCESS, str(file), what], cwd=ROOT,
                          capture_output=True, text=True, check=False, timeout=30)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def test_a_full_disk_is_one_line_and_the_states_before_it_stay(sqlite_store, file):
    count, error = in_a_process(file, "full")[0].split(" ", 1)
    assert int(count) >= 3
    assert error.startswith(f"{file}: ")
    records = sqlite_store(2).load().records
    assert records[0].state == b"room again"
    assert records[1].state == b"%04d" % (int(count) - 1) * 500


def test_what_was_kept_is_found_though_the_disk_is_full(sqlite_store, file):
    store = sqlite_store(1)
    for number in range(60):
        store.save(1, b"%04d" % number * 50)
    found, error = in_a_process(file, "full at load")
    assert found == "0059" * 50
    assert error.startswith(f"{file}: ")
    assert states(sqlite_store(2))[0] == b"0059" * 50


@pytest.mark.parametrize("exists", [True, False])
def test_a_read_only_directory_is_one_line(exists):
    directory = Path(tempfile.mkdtemp())  # where a user without rights can get to
    file = directory / "node.sqlite"
    try:
        if exists:
            store = SqliteCheckpoints(file, "run", 1, sync_period_s=0)
            store.save(1, b"x")
            store.close()
            file.chmod(0o444)
        directory.chmod(0o555)
        lines = in_a_process(file, "read-only")
    finally:
        directory.chmod(0o755)
        shutil.rmtree(directory)
    assert len(lines) == 2
    assert all(line.startswith(f"{file}: ") for line in lines), lines


def test_the_thread_syncs_and_cuts_the_log(file):
    store = SqliteCheckpoints(file, "run", 1, sync_period_s=0, log_limit_bytes=50_000)
    log = file.with_name("node.sqlite-wal")
    store.save(1, b"x" * 3000)
    store.sync()
    largest = 0
    for number in range(100):
        store.save(1, b"%d" % number * 1000)
        largest = max(largest, log.stat().st_size)
        store.sync()
    assert 50_000 < largest < 100_000
    assert store.trouble() == ""
    store.close()
    assert not log.exists()
    second = SqliteCheckpoints(file, "run", 2, sync_period_s=0)
    assert states(second)[0] == b"99" * 1000
    second.close()


def test_a_state_that_is_far_too_large_is_refused_and_the_one_before_stays(sqlite_store):
    store = sqlite_store(1)
    store.save(1, b"x" * LARGEST_STATE_BYTES)
    with pytest.raises(CheckpointError, match=r"a state of \d+ bytes is too large"):
        store.save(1, b"y" * (LARGEST_STATE_BYTES + 1))
    assert states(sqlite_store(2)) == [b"x" * LARGEST_STATE_BYTES]


def test_a_sync_that_fails_is_told(file):
    store = SqliteCheckpoints(file, "run", 1, sync_period_s=0.001)
    store.save(1, b"x")
    file.with_name("node.sqlite-wal").rename(file.with_name("gone"))
    told = ""
    for number in range(10_000):
        store.save(1, b"%d" % number)
        told = told or store.trouble()
        if told:
            break
    assert "not synced to the disk" in told
    store.close()


# -- killed in the middle ------------------------------------------------------------------------


def crash(tmp_path: Path, mode: str, first: int, last: int, step: int) -> list[dict]:
    done = subprocess.run(
        [sys.executable, "-m", "tests.actors.runtime.checkpoint_crasher", str(tmp_path), mode,
         str(first), str(last), str(step)], cwd=ROOT, capture_output=True, text=True, check=False,
        env={**os.environ, "PYTHONPATH": str(ROOT)}, timeout=100)
    assert done.returncode == 0, done.stderr
    return [json.loads(line) for line in done.stdout.splitlines()]


@pytest.mark.parametrize(("mode", "step", "number"), [
    ("limits", 1100, signal.SIGXFSZ), ("random", 500, signal.SIGKILL)])
def test_a_process_killed_in_any_write_leaves_its_last_acknowledged_state_or_the_next(
        tmp_path, mode, step, number):
    lives = crash(tmp_path, mode, 0, 60 * step, step)
    assert len(lives) == 60
    assert sum(life["signal"] == number for life in lives) >= 50
    assert len({life["acknowledged"] for life in lives}) > 10, "always killed at the same point"
    before = 0
    for index, life in enumerate(lives):
        if index % 7 == 0:
            before = 0  # an empty directory
        assert life["problems"] == []
        assert -1 not in life["kept"], "a state that was never saved"
        oldest = life["acknowledged"] or before
        start = 1 + 2 * SAVES * (index % 7)
        following = life["acknowledged"] + 1 if life["acknowledged"] else start
        assert life["found"] in (oldest, following), life
        before = life["found"]


# -- the keeper ----------------------------------------------------------------------------------


class Broken:
    """A store that fails as long as it is told to."""

    def __init__(self, shelf: Shelf) -> None:
        self.inner = MemoryCheckpoints(shelf, 1)
        self.error: CheckpointError | None = CheckpointError("n.sqlite: disk full")
        self.attempts = 0

    def save(self, version, state):
        self.attempts += 1
        if self.error:
            raise self.error
        self.inner.save(version, state)

    def load(self):
        if self.error:
            raise self.error
        return self.inner.load()

    def note_failures(self, failures):
        if self.error:
            raise self.error
        self.inner.note_failures(failures)

    def trouble(self):
        return ""

    def close(self):
        pass


class Desk:
    """A keeper, its clock, and what it has reported."""

    def __init__(self, store: CheckpointStore, *, expected: bool = False) -> None:
        self.now_s = 0.0
        self.told: list[str] = []
        self.keeper = Keeper(store, self.told.append, lambda: self.now_s, expected=expected)


def test_a_keeper_saves_a_state_once():
    shelf = Shelf()
    desk = Desk(MemoryCheckpoints(shelf, 1))
    for count in (1, 1, 2, 2, 1):
        desk.keeper.keep(COUNTER, Counter(count, 0))
    assert [COUNTER.decode(r.version, r.state).count for r in shelf.records] == [1, 2, 1]
    assert desk.told == []


def test_a_keeper_goes_on_without_a_store_tries_again_ever_more_seldom_and_says_so_once():
    store = Broken(Shelf())
    desk = Desk(store)
    assert desk.keeper.kept(COUNTER) is None
    for tick in range(1000):
        desk.now_s = tick / 10
        desk.keeper.keep(COUNTER, Counter(tick, 0))
    assert 5 < store.attempts < 10
    assert desk.told == ["n.sqlite: disk full; starting without a checkpoint",
                         "n.sqlite: disk full; going on without checkpoints"]
    store.error = None
    desk.now_s += RETRY_S[1]
    desk.keeper.keep(COUNTER, Counter(1, 0))
    desk.keeper.keep(COUNTER, Counter(2, 0))
    assert desk.told[2:] == ["checkpoints are kept again"]
    assert len(store.inner.load().records) == 2


def test_a_store_that_is_locked_for_a_moment_is_no_trouble_and_for_long_it_is():
    store = Broken(Shelf())
    desk = Desk(store)
    store.error = BusyError("n.sqlite: database is locked")
    for moment in (0.0, 0.2, 0.4):
        desk.now_s = moment
        desk.keeper.keep(COUNTER, Counter(1, 0))
    store.error = None
    desk.now_s = 0.6
    desk.keeper.keep(COUNTER, Counter(1, 0))
    assert (store.attempts, desk.told) == (4, [])
    store.error = BusyError("n.sqlite: database is locked")
    for tick in range(100):
        desk.now_s = 1.0 + tick / 10
        desk.keeper.keep(COUNTER, Counter(2, 0))
    assert desk.told == ["n.sqlite: database is locked; going on without checkpoints"]
    assert store.attempts < 15


def test_a_store_that_is_locked_for_a_moment_while_it_is_read_is_read_again():
    class Locked(Broken):
        def load(self):
            self.attempts += 1
            if self.attempts < BUSY_TIMES:
                raise BusyError("n.sqlite: database is locked")
            return self.inner.load()

    desk = Desk(Locked(Shelf(1, (record(3, {"count": 4, "step": 0}),))), expected=True)
    assert desk.keeper.kept(COUNTER) == Counter(4, 0)
    assert desk.told == []
    stays = Broken(Shelf())
    stays.error = BusyError("n.sqlite: database is locked")
    desk = Desk(stays)
    assert desk.keeper.kept(COUNTER) is None
    assert desk.told == ["n.sqlite: database is locked; starting without a checkpoint"]


@pytest.mark.parametrize("error", [ValueError("what nobody thought of"), RecursionError("deep")])
def test_a_store_that_raises_whatever_it_likes_ends_nobody(error):
    store = Broken(Shelf())
    store.error = error
    desk = Desk(store, expected=True)
    assert desk.keeper.kept(COUNTER) is None
    desk.keeper.keep(COUNTER, Counter(1, 0))
    desk.keeper.failed()
    told = f"{type(error).__name__}: {error}"
    assert desk.told == [f"{told}; starting without a checkpoint",
                         f"{told}; going on without checkpoints", told]


def test_a_superseded_keeper_is_told_so_and_tries_no_more():
    store = Broken(Shelf())
    store.error = SupersededError("n.sqlite: incarnation 1 was superseded")
    desk = Desk(store)
    for tick in range(100):
        desk.now_s = float(tick)
        desk.keeper.keep(COUNTER, Counter(tick, 0))
    assert store.attempts == 1
    assert len(desk.told) == 1


def test_the_first_life_expects_nothing_and_a_later_one_says_that_nothing_was_found():
    first, later = Desk(MemoryCheckpoints(Shelf(), 1)), Desk(
        MemoryCheckpoints(Shelf(), 2), expected=True)
    assert first.keeper.kept(COUNTER) is None
    assert later.keeper.kept(COUNTER) is None
    assert first.told == []
    assert later.told == ["no checkpoint was found; starting without a checkpoint"]


def test_a_keeper_names_what_it_passed_over():
    shelf = Shelf(1, (record(3, {"count": -1, "step": 0}, 2), record(3, {"count": 4, "step": 0})))
    desk = Desk(MemoryCheckpoints(shelf, 2), expected=True)
    assert desk.keeper.kept(COUNTER) == Counter(4, 0)
    assert desk.told == ["generation 2: a Counter that makes no sense: it is negative; "
                         "taking the newest sound one"]


def test_a_state_that_lives_fail_with_soon_is_given_up_and_one_that_works_is_not():
    shelf = Shelf()
    Desk(MemoryCheckpoints(shelf, 1)).keeper.keep(COUNTER, Counter(13, 0))
    for incarnation in range(2, 2 + FAILED_IN_A_ROW):
        desk = Desk(MemoryCheckpoints(shelf, incarnation))
        assert desk.keeper.kept(COUNTER) == Counter(13, 0)
        desk.now_s = SOON_S / 2
        desk.keeper.failed()
    last = Desk(MemoryCheckpoints(shelf, 9), expected=True)
    assert last.keeper.kept(COUNTER) is None
    assert last.told == [f"{FAILED_IN_A_ROW} processes in a row have failed with the state kept; "
                         "starting without it"]
    assert shelf.failures == 0


def test_lives_that_fail_late_or_are_killed_do_not_count_against_the_state():
    shelf = Shelf()
    Desk(MemoryCheckpoints(shelf, 1)).keeper.keep(COUNTER, Counter(13, 0))
    for incarnation in range(2, 20):
        desk = Desk(MemoryCheckpoints(shelf, incarnation))
        assert desk.keeper.kept(COUNTER) is not None
        if incarnation % 3:
            desk.now_s = SOON_S * 2
            desk.keeper.keep(COUNTER, Counter(incarnation, 0))
            if incarnation % 2:
                desk.keeper.failed()
        else:
            desk.keeper.failed()
