"""A process that saves checkpoints until something kills it; for the crash-consistency tests.

`python checkpoint_crasher.py DIRECTORY random|limits FIRST LAST STEP`: for each number it forks a
child that saves states 1, 2, 3, … and acknowledges each on a pipe when `save` has returned. With
`random` the parent kills the child so many microseconds after its start, or after its first
acknowledgement; with `limits` the child may write no file beyond so many bytes, and the kernel
kills it (SIGXFSZ) in the write that would. Then the parent opens the file as a successor would, and
prints one JSON line: the number, whether the child was killed, the last state acknowledged, the
state found (0 for none), and the problems reported.
"""

from __future__ import annotations

import json
import os
import resource
import select
import signal
import sys
import time
from pathlib import Path

from rampart.actors.runtime.checkpoint_store import SqliteCheckpoints

SAVES = 400
LOG_LIMIT = 40_000
"""Small, so that the log is copied and cut many times within one life."""


def state(number: int) -> bytes:
    """Return the bytes of a state; its length varies, over pages too."""
    return number.to_bytes(8, "big") + bytes([number % 251]) * (number * 37 % 9000)


def number_in(data: bytes) -> int:
    """Return the number of a state, or -1 if it is none."""
    number = int.from_bytes(data[:8], "big")
    return number if data == state(number) else -1


def live(file: Path, acknowledge: int, start: int) -> None:
    store = SqliteCheckpoints(file, "run", start, sync_period_s=0.002, log_limit_bytes=LOG_LIMIT)
    store.load()
    for number in range(start, start + SAVES):
        store.save(1, state(number))
        os.write(acknowledge, number.to_bytes(8, "big"))
    store.close()


def child(file: Path, acknowledge: int, mode: str, number: int, start: int) -> None:
    if mode == "limits":
        signal.signal(signal.SIGXFSZ, signal.SIG_DFL)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        resource.setrlimit(resource.RLIMIT_FSIZE, (number, number))
    live(file, acknowledge, start)


def one(file: Path, mode: str, number: int, start: int) -> dict[str, object]:
    """Have one child live and die, and tell what it left."""
    read_end, write_end = os.pipe()
    pid = os.fork()
    if pid == 0:
        code = 1
        try:
            os.close(read_end)
            child(file, write_end, mode, number, start)
            code = 0
        finally:
            os._exit(code)
    os.close(write_end)
    if mode == "random":
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
    store = SqliteCheckpoints(file, "run", start + SAVES, sync_period_s=0)
    loaded = store.load()
    found = number_in(loaded.records[0].state) if loaded.records else 0
    others = [number_in(record.state) for record in loaded.records]
    store.save(1, state(found))  # and it works
    store.close()
    return {"number": number, "killed": os.WIFSIGNALED(status), "acknowledged": last,
            "found": found, "kept": others, "problems": loaded.problems,
            "signal": os.WTERMSIG(status) if os.WIFSIGNALED(status) else 0}


def main() -> None:
    directory, mode = Path(sys.argv[1]), sys.argv[2]
    start = 1
    for number in range(*map(int, sys.argv[3:6])):
        # Every death is survived by the same file; every seventh meets an empty directory.
        index = number // int(sys.argv[5])
        file = directory / f"{mode}-{index // 7}.sqlite"
        start = 1 if index % 7 == 0 else start + 2 * SAVES
        print(json.dumps(one(file, mode, number, start)), flush=True)


if __name__ == "__main__":
    main()
