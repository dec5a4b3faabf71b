"""Runs inputs on one target, in a process of its own, until one is too much for it.

An input is put into a file in shared memory before it is run, so that it is known when the process
dies of it: by SIGPROF, which the kernel sends when it took too much processor time, also inside of
a library that is not Python; or by whatever else kills it. Memory is bounded by the kernel too.

    python -m fuzz.worker TARGET FOLDER FIRST RUNS SEED ENGINE
"""

from __future__ import annotations

import contextlib
import gc
import json
import mmap
import os
import resource
import signal
import struct
import sys
import tempfile
from collections.abc import Iterable
from pathlib import Path
from random import Random
from typing import Any

STATUS = struct.Struct("<QQQQ")
"""Inputs run, inputs refused, inputs kept to go on from, length of the one that runs."""

_KEPT = 2000
_COLLECT_EVERY = 1000
_GATHERED = 4
"""Times an input's share, that all of them together may leave behind; libFuzzer needs some."""


def _memory_bytes() -> int:
    return int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()


class Board:
    """What the runner can read of a worker, alive or dead.

    Args:
        path: of the file.
        size: bytes of the longest input.
    """

    def __init__(self, path: Path, size: int) -> None:
        if not path.exists():
            path.write_bytes(bytes(STATUS.size + size))
        with path.open("r+b") as file:
            self._memory = mmap.mmap(file.fileno(), 0)
        self.run = self.refused = self.kept = 0

    def show(self, data: bytes) -> None:
        """Write down the input that is about to run."""
        self._memory[STATUS.size:STATUS.size + len(data)] = data
        STATUS.pack_into(self._memory, 0, self.run, self.refused, self.kept, len(data))

    def read(self) -> tuple[tuple[int, int, int], bytes]:
        """Return the counts, and the input that was run last."""
        *counts, length = STATUS.unpack_from(self._memory, 0)
        data = self._memory[STATUS.size:STATUS.size + length]
        return (counts[0], counts[1], counts[2]), bytes(data)


class Worker:
    """Runs inputs under limits and keeps what they find.

    Args:
        target: what is fuzzed.
        folder: for the board, and for findings.
        board: where counts and inputs are shown.
    """

    def __init__(self, target: Any, folder: Path, board: Board) -> None:
        from tests.fuzz.target import LIMIT_BYTES, LIMIT_S, place_of

        self._target = target
        self.folder = folder
        self._place_of = place_of
        self._limit_s = LIMIT_S
        self._outcomes: set[str] = set()
        self._found: set[str] = set()
        self.board = board
        self._limit_bytes = LIMIT_BYTES
        self._most_bytes = _memory_bytes() + _GATHERED * LIMIT_BYTES
        self._bound_memory()
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        signal.signal(signal.SIGPROF, signal.SIG_DFL)  # which ends the process

    def _bound_memory(self) -> None:
        """Allow an input its share on top of what has gathered; that has a bound of its own."""
        most = min(_memory_bytes() + self._limit_bytes, self._most_bytes)
        resource.setrlimit(resource.RLIMIT_AS, (most, self._most_bytes))

    def try_one(self, data: bytes) -> bool:
        """Run one input and return whether its outcome was new."""
        board = self.board
        board.show(data)
        signal.setitimer(signal.ITIMER_PROF, self._limit_s)
        try:
            outcome = self._target.outcome(data)
        except (Exception, RecursionError) as error:
            signal.setitimer(signal.ITIMER_PROF, 0)
            outcome = self._place_of(error)
            if outcome not in self._found:
                self._found.add(outcome)
                self._keep(outcome, self._smaller(data, outcome))
        signal.setitimer(signal.ITIMER_PROF, 0)
        board.run += 1
        board.refused += outcome != "read"
        if board.run % _COLLECT_EVERY == 0:
            gc.collect()
            self._bound_memory()
        if outcome in self._outcomes:
            return False
        self._outcomes.add(outcome)
        return True

    def _smaller(self, data: bytes, place: str) -> bytes:
        """Leave out of a finding what it does not need, in halves, quarters, and so on."""
        size, tries = len(data) // 2, 0
        while size and tries < 400:
            at = 0
            while at < len(data) and tries < 400:
                tries += 1
                shorter = data[:at] + data[at + size:]
                self.board.show(shorter)
                signal.setitimer(signal.ITIMER_PROF, self._limit_s)
                try:
                    self._target.outcome(shorter)
                    same = False
                except Exception as error:
                    same = self._place_of(error) == place
                signal.setitimer(signal.ITIMER_PROF, 0)
                if same:
                    data = shorter
                else:
                    at += size
            size //= 2
        return data

    def _keep(self, place: str, data: bytes) -> None:
        name = f"found-{os.getpid()}-{len(self._found)}"
        (self.folder / name).write_bytes(data)
        (self.folder / f"{name}.json").write_text(json.dumps({"what": place}))


def go_on(worker: Worker, target: Any, runs: int, seed: int) -> None:
    """Make inputs by our own engine: from samples, and from inputs whose outcome was new."""
    from tests.fuzz.mutate import Mutator

    draw = Random(seed)
    pool = [*target.samples(), *target.corpus()]
    mutated = Mutator(target.kind, target.words)
    own = len(pool)
    for _ in range(runs):
        # Half of them from what is read: most of what is new is a new way to be refused.
        base = pool[draw.randrange(own)] if draw.random() < 0.5 else draw.choice(pool)
        data = mutated(base, draw.choice(pool), draw)
        if worker.try_one(data):
            if len(pool) < own + _KEPT:
                pool.append(data)
            worker.board.kept = len(pool) - own


def go_on_guided(worker: Worker, target: Any, runs: int, seed: int, inputs: Iterable[bytes]
                 ) -> None:
    """Make inputs by libFuzzer, which keeps those that reach new code; does not return."""
    import atheris

    from tests.fuzz.mutate import Mutator
    from tests.fuzz.target import MAX_INPUT

    folder = worker.folder / "reached"
    folder.mkdir(exist_ok=True)
    pool = list(inputs)
    for number, data in enumerate(pool):
        (folder / f"{number}").write_bytes(data)
    own = Mutator(target.kind, target.words)

    def mutated(data: bytes, most: int, number: int) -> bytes:
        draw = Random(number)
        if draw.random() < 0.5:
            return bytes(atheris.Mutate(data, most))
        return own(data, draw.choice(pool), draw)[:most]

    def one(data: bytes) -> None:
        worker.board.kept += worker.try_one(data)

    atheris.Setup(["fuzz", f"-runs={runs}", f"-seed={seed % (1 << 31)}", f"-max_len={MAX_INPUT}",
                   "-rss_limit_mb=0", "-timeout=100000", "-verbosity=0", "-print_final_stats=0",
                   str(folder)], one, custom_mutator=mutated)
    atheris.Fuzz()


def main() -> int:
    """Run what the command line asks for."""
    name, folder, first, runs, seed, engine = sys.argv[1:]
    tempfile.tempdir = folder
    if engine == "guided":
        import atheris
        with atheris.instrument_imports(include=["rampart"]):
            from tests.fuzz import targets
    else:
        from tests.fuzz import targets
    from tests.fuzz.target import MAX_INPUT

    target = targets.ALL[name]
    samples = [*target.samples(), *target.corpus()]  # before the limits: they load what is lazy
    for data in samples:
        with contextlib.suppress(Exception):
            target.outcome(data)
    board = Board(Path(folder) / "board", MAX_INPUT)
    board.run = int(first)
    worker = Worker(target, Path(folder), board)
    if engine == "one":
        worker.try_one((Path(folder) / "one").read_bytes())
        return 0
    for data in samples if int(first) == 0 else []:
        worker.try_one(data)
    left = int(runs) - board.run
    if engine == "guided":
        go_on_guided(worker, target, left, int(seed), samples)
    else:
        go_on(worker, target, left, int(seed))
    board.show(b"")
    return 0


if __name__ == "__main__":
    sys.exit(main())
