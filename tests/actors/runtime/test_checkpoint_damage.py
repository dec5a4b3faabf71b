"""A damaged checkpoint file: whatever lies there, the node starts, says so, and keeps its state.

Each test damages a file in one way and has it go through `outlived`, which is a whole respawn: a
keeper looks for a state, keeps a new one, and the next life finds that.
"""

from __future__ import annotations

import os
import random
import shutil
import socket
import sqlite3
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rampart.actors.runtime import checkpoint_file
from rampart.actors.runtime.checkpoint import Keeper, StateFormat
from rampart.actors.runtime.checkpoint_file import (
    APPLICATION,
    LARGEST_FILE_BYTES,
    LARGEST_STATE_BYTES,
    STORE_FORMAT,
    SUFFIXES,
    beside,
)
from rampart.actors.runtime.checkpoint_store import SqliteCheckpoints
from tests import ROOT

SAVED = 6
NEW = 1000


class Counter(msgspec.Struct, frozen=True):
    """A state of some hundred bytes, all of them known from its number."""

    count: int
    text: str


FORM = StateFormat(Counter)


def state(count: int) -> Counter:
    return Counter(count, f"state {count} " * 12)


def kept(file: Path, incarnation: int) -> tuple[Counter | None, Keeper, list[str]]:
    """Start a life on a file; return what it finds, its keeper, and what it reports."""
    told: list[str] = []
    keeper = Keeper(SqliteCheckpoints(file, "run", incarnation, sync_period_s=0), told.append,
                    lambda: 0.0, expected=True)
    return keeper.kept(FORM), keeper, told


def outlived(file: Path) -> tuple[int, list[str]]:
    """Respawn on a file; return the number of the state found, 0 for none, and the reports.

    Whatever the file is: what is found was once saved, anything but the newest is reported in one
    line, and a new state is kept, which the next life finds without complaint.
    """
    found, keeper, told = kept(file, 2)
    assert found is None or found in [state(count) for count in range(1, SAVED + 1)]
    assert len(told) <= 1
    assert told or found == state(SAVED)
    assert not any("\n" in line for line in told)
    keeper.keep(FORM, state(NEW))
    keeper.failed()
    keeper.close()
    assert len(told) <= 1, told
    after, keeper, complaints = kept(file, 3)
    keeper.close()
    assert (after, complaints) == (state(NEW), [])
    return found.count if found else 0, told


@pytest.fixture
def directory() -> Iterator[Path]:
    """In memory if there is such a place: files are made by the thousand."""
    place = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=place if os.access(place, os.W_OK) else None) as made:
        yield Path(made)


@pytest.fixture
def file(directory) -> Path:
    """A file as a life leaves it that was closed in order."""
    made = directory / "node.sqlite"
    store = SqliteCheckpoints(made, "run", 1, sync_period_s=0)
    for count in range(1, SAVED + 1):
        store.save(1, FORM.encode(state(count)))
    store.close()
    return made


def write(file: Path, content: bytes) -> None:
    """Have a file, and nothing beside it."""
    for path in file.parent.iterdir():
        path.unlink()
    file.write_bytes(content)


def edited(file: Path, *statements: str) -> None:
    """Run statements on a file, while its tables have no constraints."""
    connection = sqlite3.connect(file, isolation_level=None)
    tables = connection.execute("SELECT name, sql FROM sqlite_schema").fetchall()
    _define(connection, [(name, sql.replace("NOT NULL", "").replace("CHECK (id = 0)", ""))
                         for name, sql in tables])
    connection.close()
    connection = sqlite3.connect(file, isolation_level=None)
    for statement in statements:
        connection.execute(statement)
    _define(connection, tables)
    connection.close()


def _define(connection: sqlite3.Connection, tables: list[tuple[str, str]]) -> None:
    connection.execute("PRAGMA writable_schema = ON")
    connection.executemany("UPDATE sqlite_schema SET sql = ?2 WHERE name = ?1", tables)


# -- bits and bytes ------------------------------------------------------------------------------


def flip(content: bytes, bit: int) -> bytes:
    damaged = bytearray(content)
    damaged[bit // 8] ^= 1 << bit % 8
    return bytes(damaged)


def test_a_file_that_was_left_in_order_is_found_in_order(file):
    assert outlived(file) == (SAVED, [])


def test_any_bit_of_the_file_may_be_wrong(file):
    content = file.read_bytes()
    outcomes = set()
    for bit in random.Random(16).sample(range(8 * len(content)), 600):
        write(file, flip(content, bit))
        outcomes.add(outlived(file)[0])
    assert outcomes == {0, SAVED - 1, SAVED}


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("part", range(8))
def test_each_bit_of_the_file_may_be_wrong(file, part):
    content = file.read_bytes()
    for bit in range(part, 8 * len(content), 8):
        write(file, flip(content, bit))
        outlived(file)


@pytest.mark.parametrize("step", [
    97, pytest.param(1, marks=[pytest.mark.slow, pytest.mark.timeout(1800)])])
def test_the_file_may_end_anywhere(file, step):
    content = file.read_bytes()
    for size in range(0, len(content), step):
        write(file, content[:size])
        assert outlived(file)[1]


@pytest.fixture
def killed(directory) -> dict[str, bytes]:
    """What a life leaves that was killed: a database, its log and the log's index."""
    file = directory / "killed.sqlite"
    store = SqliteCheckpoints(file, "run", 1, sync_period_s=0)
    for count in range(1, SAVED + 1):
        store.save(1, FORM.encode(state(count)))
    left = {suffix: beside(file, suffix).read_bytes() for suffix in SUFFIXES[:3]}
    store.close()
    for path in directory.iterdir():
        path.unlink()
    return left


def lay(file: Path, left: dict[str, bytes]) -> None:
    for path in file.parent.iterdir():
        path.unlink()
    for suffix, content in left.items():
        beside(file, suffix).write_bytes(content)


@pytest.mark.parametrize("count", [
    200, pytest.param(20_000, marks=[pytest.mark.slow, pytest.mark.timeout(1800)])])
def test_any_bit_of_what_a_killed_life_leaves_may_be_wrong(directory, killed, count):
    """A torn log ends where it is torn, by SQLite's rules: an older state may come unreported."""
    dice, file = random.Random(16), directory / "node.sqlite"
    for _ in range(count):
        suffix = dice.choice(list(killed))
        bit = dice.randrange(8 * len(killed[suffix]))
        lay(file, {**killed, suffix: flip(killed[suffix], bit)})
        found, keeper, told = kept(file, 2)
        assert found is None or found == state(found.count)
        assert found is not None or told
        keeper.keep(FORM, state(NEW))
        keeper.close()
        after, keeper, complaints = kept(file, 3)
        keeper.close()
        assert (after, complaints) == (state(NEW), [])


@settings(deadline=None, max_examples=60,
          suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.sampled_from(SUFFIXES), st.integers(0, 6000), st.binary(min_size=1, max_size=1500))
def test_garbage_anywhere_in_the_file_or_beside_it(file, suffix, offset, garbage):
    """Garbage beside a file is a log that was never whole: SQLite leaves it out without a word."""
    if not hasattr(test_garbage_anywhere_in_the_file_or_beside_it, "content"):
        test_garbage_anywhere_in_the_file_or_beside_it.content = file.read_bytes()
    content = test_garbage_anywhere_in_the_file_or_beside_it.content
    write(file, content)
    if suffix:
        beside(file, suffix).write_bytes(garbage)
    else:
        offset %= len(content)
        file.write_bytes(content[:offset] + garbage + content[offset + len(garbage):])
    outlived(file)


# -- values --------------------------------------------------------------------------------------

OWNERS = {"run": "'run'", "incarnation": "1", "failures": "0", "checksum": "x'00'"}
RECORDS = ("slot", "generation", "incarnation", "version", "state", "checksum")
VALUES = ("NULL", "''", "'text'", "x''", "x'ff'", "CAST(x'c328' AS TEXT)", "1e300", "-1", "1.5",
          "9223372036854775807", "-9223372036854775808", "zeroblob(100000)")


@pytest.mark.parametrize("value", VALUES)
@pytest.mark.parametrize("column", OWNERS)
def test_the_owner_may_be_any_value(file, column, value):
    edited(file, f"UPDATE owner SET {column} = {value}")
    found, told = outlived(file)
    assert "owner" in told[0] or "pages" in told[0]
    assert found == SAVED, "the states say themselves whose they are"


def test_an_owner_of_nothing_but_nulls(file):
    edited(file, "UPDATE owner SET run = NULL, incarnation = NULL, failures = NULL,"
                 " checksum = NULL")
    assert outlived(file)[0] == SAVED


@pytest.mark.parametrize("value", VALUES)
@pytest.mark.parametrize("column", RECORDS[1:])
def test_the_newest_record_may_be_any_value(file, column, value):
    edited(file, f"UPDATE checkpoint SET {column} = {value} WHERE generation = {SAVED}")
    assert outlived(file)[0] == SAVED - 1


@pytest.mark.parametrize("statement", [
    "DELETE FROM owner",
    "INSERT INTO owner SELECT 1, run, incarnation, failures, checksum FROM owner",
    f"UPDATE checkpoint SET slot = 77 WHERE generation = {SAVED}",
    f"UPDATE checkpoint SET slot = -1 WHERE generation = {SAVED}",
    "UPDATE checkpoint SET slot = slot + 1000",
    "UPDATE owner SET run = 'another'",
    "UPDATE owner SET failures = 99",
    "UPDATE owner SET incarnation = 99",
])
def test_rows_that_are_missing_out_of_place_or_changed(file, statement):
    edited(file, statement)
    assert outlived(file)[1]


HOSTILE = {
    "trigger": ["CREATE TRIGGER t AFTER INSERT ON checkpoint BEGIN DELETE FROM checkpoint; END"],
    "view": ["ALTER TABLE owner RENAME TO o", "CREATE VIEW owner AS SELECT * FROM o"],
    "view that never ends": [
        "DROP TABLE owner",
        "CREATE VIEW owner AS WITH RECURSIVE r(n) AS (SELECT 1 UNION ALL SELECT n FROM r)"
        " SELECT n AS run, n AS incarnation, n AS failures, n AS checksum FROM r WHERE n > 1"],
    "other tables": ["DROP TABLE owner", "DROP TABLE checkpoint", "CREATE TABLE shopping (x)"],
    "no tables": ["DROP TABLE owner", "DROP TABLE checkpoint"],
    "a column more": ["ALTER TABLE owner ADD COLUMN more"],
    "a column less": ["ALTER TABLE owner DROP COLUMN failures"],
    "an index": ["CREATE INDEX i ON checkpoint (incarnation)"],
    "a table more": ["CREATE TABLE more (x)"],
    "newer format": [f"PRAGMA user_version = {STORE_FORMAT + 1}"],
    "absurd format": ["PRAGMA user_version = -7"],
    "another program's": [f"PRAGMA application_id = {APPLICATION + 1}"],
    "no log": ["PRAGMA journal_mode = DELETE"],
    "large record": [f"UPDATE checkpoint SET state = zeroblob({4 * LARGEST_STATE_BYTES})"
                     f" WHERE generation = {SAVED}"],
    "large owner": [f"UPDATE owner SET run = zeroblob({4 * LARGEST_STATE_BYTES})"],
}


@pytest.mark.parametrize("statements", HOSTILE.values(), ids=HOSTILE)
def test_a_database_that_is_another_or_up_to_something(file, statements):
    connection = sqlite3.connect(file, isolation_level=None)
    for statement in statements:
        connection.execute(statement)
    connection.close()
    assert "kept as node.damaged, begun anew" in outlived(file)[1][0]


def test_a_schema_that_would_take_minutes_to_load_is_left_after_some_steps(file):
    connection = sqlite3.connect(file, isolation_level=None)
    connection.execute("PRAGMA writable_schema = ON")
    connection.execute("BEGIN")
    connection.executemany("INSERT INTO sqlite_schema VALUES ('table', ?1, ?1, 2, ?2)", (
        (f"t{number}", f"CREATE TABLE t{number} (x)") for number in range(100_000)))
    connection.execute("COMMIT")
    connection.close()
    assert "interrupted" in outlived(file)[1][0]


MEMORY = """
import resource, sys
from pathlib import Path
from rampart.actors.runtime.checkpoint_store import SqliteCheckpoints
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
store = SqliteCheckpoints(Path(sys.argv[1]), "run", 2, sync_period_s=0)
problems = store.load().problems
store.close()
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before, problems)
"""


def test_a_record_of_a_hundred_megabytes_costs_no_memory(file):
    connection = sqlite3.connect(file, isolation_level=None)
    connection.execute(f"UPDATE checkpoint SET state = zeroblob({60 * LARGEST_STATE_BYTES})"
                       f" WHERE generation = {SAVED}")
    connection.close()
    done = subprocess.run([sys.executable, "-c", MEMORY, str(file)], cwd=ROOT, text=True,
                          capture_output=True, check=True, timeout=60)
    kilobytes, told = done.stdout.split(maxsplit=1)
    assert int(kilobytes) < 20 * LARGEST_STATE_BYTES / 1024
    assert "too big" in told


# -- what is no file -----------------------------------------------------------------------------


def a_socket(path: Path) -> None:
    here = Path.cwd()
    os.chdir(path.parent)  # the name of a socket must be short
    try:
        with socket.socket(socket.AF_UNIX) as made:
            made.bind(path.name)
    finally:
        os.chdir(here)


def a_full_directory(path: Path) -> None:
    path.mkdir()
    (path / "in it").write_text("something of somebody's")


def a_file_of(size: int) -> Callable[[Path], None]:
    def make(path: Path) -> None:
        path.touch()
        os.truncate(path, size)

    return make


IN_ITS_PLACE = {
    "FIFO": os.mkfifo, "socket": a_socket, "directory": Path.mkdir,
    "full directory": a_full_directory,
    "dangling link": lambda path: path.symlink_to("nowhere"),
    "link to itself": lambda path: path.symlink_to(path),
    "endless device": lambda path: path.symlink_to("/dev/zero"),
    "full device": lambda path: path.symlink_to("/dev/full"),
    "link to a FIFO": lambda path: (os.mkfifo(path.parent / "fifo"), path.symlink_to("fifo")),
    "huge": a_file_of(LARGEST_FILE_BYTES + 1),
    "a terabyte": a_file_of(1 << 40),
}


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("make", IN_ITS_PLACE.values(), ids=IN_ITS_PLACE)
def test_something_else_in_the_place_of_the_file_or_beside_it(file, make, suffix):
    beside(file, suffix).unlink(missing_ok=True)
    make(beside(file, suffix))
    found, told = outlived(file)
    assert found == 0
    assert f"node.sqlite{suffix} " in told[0]
    assert os.path.lexists(beside(file.with_suffix(".damaged"), suffix))
    assert file.is_file()


def test_a_link_to_another_nodes_file_is_not_followed(file):
    other = file.with_name("other.sqlite")
    file.rename(other)
    before = other.read_bytes()
    file.symlink_to(other.name)
    outlived(file)
    assert other.read_bytes() == before


def test_a_file_of_another_user_is_not_believed(file, monkeypatch):
    monkeypatch.setattr(checkpoint_file, "users_of", lambda _directory: {os.geteuid() + 1})
    found, _, told = kept(file, 2)
    assert found is None
    assert f"node.sqlite belongs to user {os.geteuid()}; kept as node.damaged" in told[0]


def test_damage_again_and_again_keeps_one_damaged_file_and_never_a_directory_less(file):
    for _ in range(5):
        file.write_bytes(b"no database" * 100)
        outlived(file)
    assert {p.name for p in file.parent.iterdir()} == {"node.sqlite", "node.damaged"}
    for number in range(5):
        file.unlink()
        a_full_directory(file)
        outlived(file)
        last = file.with_suffix(f".damaged{number + 2}")
        assert (last / "in it").read_text() == "something of somebody's"


def test_where_no_damaged_file_can_be_set_aside_the_node_goes_on_without(file):
    for number in range(20):
        a_full_directory(file.with_suffix(f".damaged{number or ''}"))
    file.write_bytes(b"no database" * 100)
    found, keeper, told = kept(file, 2)
    assert found is None
    assert "cannot be set aside" in told[0]
    keeper.keep(FORM, state(NEW))
    keeper.close()
    assert told[1].endswith("going on without checkpoints")


PERMISSIONS = """
import os, sys
from pathlib import Path
from rampart.actors.runtime.checkpoint_store import SqliteCheckpoints
if os.getuid() == 0:
    os.setuid(65534)
file, mode = Path(sys.argv[1]), int(sys.argv[2], 8)
store = SqliteCheckpoints(file, "run", 1, sync_period_s=0)
store.save(1, b"one")
store.close()
file.chmod(mode)
store = SqliteCheckpoints(file, "run", 2, sync_period_s=0)
loaded = store.load()
print([r.state for r in loaded.records], len(loaded.problems))
store.save(1, b"two")
store.close()
store = SqliteCheckpoints(file, "run", 3, sync_period_s=0)
print(store.load().records[0].state, store.load().problems)
"""


@pytest.mark.parametrize(("mode", "found"), [("000", "[]"), ("200", "[]"), ("444", "[b'one']")])
def test_a_file_without_permission_is_replaced_if_the_directory_is_ones_own(mode, found):
    directory = Path(tempfile.mkdtemp())  # where a user without rights can get to
    try:
        directory.chmod(0o777)
        done = subprocess.run(
            [sys.executable, "-c", PERMISSIONS, str(directory / "node.sqlite"), mode], cwd=ROOT,
            capture_output=True, text=True, check=False, timeout=60)
    finally:
        shutil.rmtree(directory)
    assert (done.stdout.splitlines(), done.stderr) == ([f"{found} 1", "b'two' ()"], "")


# -- in the middle of a life ---------------------------------------------------------------------


@pytest.mark.parametrize("statement", [
    "UPDATE owner SET run = NULL", "UPDATE owner SET incarnation = NULL", "DELETE FROM owner",
    "UPDATE owner SET run = 'r', checksum = NULL", "DROP TABLE checkpoint", "DROP TABLE owner"])
def test_a_file_that_is_damaged_under_a_living_node_is_begun_anew(file, statement):
    found, keeper, told = kept(file, 2)
    assert (found, told) == (state(SAVED), [])
    edited(file, statement)
    keeper.keep(FORM, state(NEW))
    assert "begun anew" in told[0]
    keeper.keep(FORM, state(NEW + 1))
    keeper.close()
    assert kept(file, 3)[0] == state(NEW + 1)


@pytest.mark.parametrize("make", IN_ITS_PLACE.values(), ids=IN_ITS_PLACE)
def test_something_else_in_the_place_of_a_living_nodes_file(file, make):
    _, keeper, told = kept(file, 2)
    file.unlink()
    make(file)
    keeper.keep(FORM, state(NEW))
    keeper.close()
    assert "begun anew" in told[0]
    assert kept(file, 3)[0] == state(NEW)
