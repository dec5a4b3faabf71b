"""The faults of all runs of a system: what detected them, where, when, how often, and their state.

A fault is one detection module, or the supervisor, and one node. Its state is debounced:

    suspected   a detection module has become active
    confirmed   a decision was made on it, or the supervisor saw the process fail
    healed      it has been gone for `HEALED_S`, or for a run; if it returns before, it is the same
                occurrence
    cleared     an operator has acknowledged it

`Debounce` is pure. `History` keeps the rows in SQLite with a write-ahead log, so a reader never
waits, and a killed writer leaves a sound file.
"""

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any, Literal

import msgspec

from rampart.actors.bus.envelope import Header
from rampart.actors.bus.limits import Remembered
from rampart.actors.ftm import messages as fm

HEALED_S = 10.0
"""Simulated seconds without a fault after which it is healed."""

MOST_ROWS = 10_000
"""Most faults of a system; the one seen longest ago goes."""

SUPERVISOR = "supervisor"
FILE = "history.sqlite"

State = Literal["suspected", "confirmed", "healed", "cleared"]

_MOST = 1000
_BUSY_S = 0.2
_TABLE = """CREATE TABLE IF NOT EXISTS fault (
    mechanism TEXT, node TEXT, error TEXT, state TEXT, first_s REAL, last_s REAL, times INTEGER,
    run TEXT, PRIMARY KEY (mechanism, node)) WITHOUT ROWID"""
_PUT = """INSERT INTO fault VALUES (:mechanism, :node, :error, :state, :last_s, :last_s, :times,
    :run) ON CONFLICT DO UPDATE SET error = excluded.error, state = excluded.state,
    last_s = excluded.last_s, times = times + excluded.times, run = excluded.run"""
_SHRINK = """DELETE FROM fault WHERE (mechanism, node) IN (
    SELECT mechanism, node FROM fault ORDER BY last_s DESC LIMIT -1 OFFSET ?)"""

_HEAL = """UPDATE fault SET state = 'healed'
    WHERE state IN ('suspected', 'confirmed') AND run NOT IN ({})"""


class Fault(msgspec.Struct, kw_only=True):
    """A row of the history; times are seconds of the wall clock (Unix time).

    Attributes:
        mechanism: detection module, or `supervisor`.
        node: failed node; "" if the detection names none.
        error: reason of the last occurrence.
        state: see the module.
        first_s: begin of the first occurrence.
        last_s: last change of state.
        times: number of occurrences.
        run: run id of the last occurrence.
    """

    mechanism: str
    node: str
    error: str
    state: State
    first_s: float = 0.0
    last_s: float = 0.0
    times: int = 0
    run: str = ""


class Debounce:
    """Turns the messages of one run into changes of the history. Pure."""

    def __init__(self) -> None:
        self._faults: dict[tuple[str, str], Fault] = Remembered(_MOST)
        self._active: dict[str, tuple[str, ...]] = Remembered(_MOST)
        self._gone_s: dict[tuple[str, str], float] = Remembered(_MOST)
        self._changed: dict[tuple[str, str], Fault] = {}

    def take(self, message: Any, header: Header, at_s: float) -> None:
        """Take a detection report, a decision, or an event of a process.

        Args:
            message: body.
            header: of the message.
            at_s: simulated time.
        """
        if isinstance(message, fm.DetectionReport):
            names = (name.partition("#")[0] for name in message.nodes or ("",))
            nodes = tuple(names) if message.state is fm.DetectionState.ACTIVE else ()
            before = self._active.get(header.source, ())
            self._active[header.source] = nodes
            for node in nodes:
                if node not in before:
                    self._begin((header.source, node), message.reason, "suspected")
            for node in before:
                if node not in nodes:
                    self._gone_s[header.source, node] = at_s
        elif isinstance(message, fm.ProcessEvent):
            if message.news == "fault" and message.event in fm.FAILURES:
                self._begin((SUPERVISOR, message.node), message.event, "confirmed")
            elif message.news == "clear" and (SUPERVISOR, message.node) in self._faults:
                self._gone_s[SUPERVISOR, message.node] = at_s
        elif isinstance(message, fm.DecisionRecord) and message.active:
            for name, nodes in self._active.items():
                for node in nodes:
                    self._turn((name, node), "suspected", "confirmed")

    def changes(self, now_s: float) -> list[Fault]:
        """Return the faults that have changed since the last call, with their new occurrences.

        Args:
            now_s: simulated time; infinity at the end of the run.
        """
        for key, gone_s in list(self._gone_s.items()):
            if now_s - gone_s >= HEALED_S:
                del self._gone_s[key]
                self._turn(key, "suspected", "healed")
                self._turn(key, "confirmed", "healed")
        changed, self._changed = self._changed, {}
        found = [msgspec.structs.replace(fault) for fault in changed.values()]
        for fault in changed.values():
            fault.times = 0
        return found

    def _begin(self, key: tuple[str, str], error: str, state: State) -> None:
        """Begin an occurrence, or continue one; a process that works again can fail again."""
        was_gone = self._gone_s.pop(key, None) is not None
        fault = self._faults.get(key)
        if fault is None:
            fault = self._faults[key] = Fault(mechanism=key[0], node=key[1], error="",
                                              state="cleared")
        if fault.state in {"healed", "cleared"} or (was_gone and key[0] == SUPERVISOR):
            fault.times += 1
            fault.state = state
        fault.error = error
        self._changed[key] = fault

    def _turn(self, key: tuple[str, str], before: State, now: State) -> None:
        fault = self._faults.get(key)
        if fault is not None and fault.state == before:
            fault.state = now
            self._changed[key] = fault


class History:
    """The history of a system on disk, for its one writer in a run.

    A damaged file is set aside. Any other problem is kept, and nothing more is written.

    Args:
        folder: existing folder of the system.
        run: run id.

    Attributes:
        problem: one line about a problem; "" if there is none.
    """

    def __init__(self, folder: Path, run: str) -> None:
        self.problem = ""
        self._path, self._run = folder / FILE, run
        self._data: sqlite3.Connection | None = None
        with self._guarded():
            try:
                self._open()
            except sqlite3.DatabaseError as error:
                if isinstance(error, sqlite3.OperationalError):
                    raise
                self._set_aside()
                self._open()

    def put(self, changes: list[Fault], at_s: float) -> None:
        """Write changed faults.

        Args:
            changes: as `Debounce.changes` returns them.
            at_s: wall clock, Unix time.
        """
        if self._data is None or not changes:
            return
        with self._guarded(), self._data:
            self._data.executemany(_PUT, [
                {**msgspec.structs.asdict(fault), "last_s": at_s, "run": self._run}
                for fault in changes])
            self._data.execute(_SHRINK, (MOST_ROWS,))

    def heal_others(self, living: Collection[str]) -> None:
        """Mark the faults of ended runs as healed, because this run has ended without them.

        Args:
            living: ids of other runs whose faults stay.
        """
        if self._data is not None:
            runs = [self._run, *living]
            with self._guarded(), self._data:
                self._data.execute(_HEAL.format(", ".join("?" * len(runs))), runs)

    def close(self) -> None:
        """Close the file."""
        if self._data is not None:
            with contextlib.suppress(sqlite3.Error):
                self._data.close()
            self._data = None

    def _open(self) -> None:
        self._data = sqlite3.connect(self._path, timeout=_BUSY_S)
        self._data.execute("PRAGMA journal_mode=WAL")
        self._data.execute(_TABLE)
        self._data.execute("SELECT first_s, times FROM fault LIMIT 1")
        if self._data.execute("PRAGMA quick_check(1)").fetchone() != ("ok",):
            raise sqlite3.DatabaseError("its pages are damaged")

    def _set_aside(self) -> None:
        self.close()
        damaged = self._path.with_suffix(".damaged")
        self._path.replace(damaged)
        for rest in ("-wal", "-shm"):
            self._path.with_name(f"{FILE}{rest}").unlink(missing_ok=True)
        self.problem = f"{self._path}: damaged; kept as {damaged.name}, a new history begins"

    @contextlib.contextmanager
    def _guarded(self) -> Iterator[None]:
        try:
            yield
        except (sqlite3.Error, OSError) as error:
            self.close()
            self.problem = f"{self._path}: {error}: the history of faults is not continued"


def read_history(folder: Path, most: int = MOST_ROWS) -> list[Fault]:
    """Return the faults of a system, the one seen last first; none without a history.

    Args:
        folder: folder of the system.
        most: most rows.

    Raises:
        ValueError: the file is damaged; the text is one line.
    """
    path = folder / FILE
    if not path.exists():
        return []
    try:
        with contextlib.closing(_opened(path)) as data:
            data.row_factory = sqlite3.Row
            return [msgspec.convert(dict(row), Fault) for row in data.execute(
                "SELECT * FROM fault ORDER BY last_s DESC LIMIT ?", (most,))]
    except (sqlite3.Error, msgspec.ValidationError) as error:
        raise ValueError(f"{path}: {error}") from None


def clear_history(folder: Path) -> int:
    """Mark the healed faults of a system as cleared, and return their number.

    Raises:
        ValueError: the file cannot be written; the text is one line.
    """
    path = folder / FILE
    if not path.exists():
        return 0
    try:
        with contextlib.closing(sqlite3.connect(path, timeout=1.0)) as data, data:
            return data.execute(
                "UPDATE fault SET state = 'cleared' WHERE state = 'healed'").rowcount
    except sqlite3.Error as error:
        raise ValueError(f"{path}: {error}") from None


def _opened(path: Path) -> sqlite3.Connection:
    """Open a history to read it, also in a folder that cannot be written."""
    uri = path.absolute().as_uri()
    writable = path.with_name(f"{FILE}-wal").exists()
    return sqlite3.connect(f"{uri}?mode=ro{'' if writable else '&immutable=1'}", uri=True,
                           timeout=_BUSY_S)
