"""A process that saves checkpoints until something kills it; for the crash-consistency tests.

`python checkpoint_crasher.py DIRECTORY LAST STEP`: for each number it forks a child that saves
states 1, 2, 3, … and acknowledges each on a pipe when `save` has returned. The parent kills the
child so many microseconds after its start, or after its first acknowledgement. Then it opens the
folder as a successor would, and prints one JSON line: whether the child ended early, the last state
acknowledged, and the states found.
"""

import json
import os
import select
import signal
import sys
import time
from pathlib import Path

from rampart.actors.runtime.checkpoint_file import FileCheckpoints

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


def main() -> None:
    directory, last, step = Path(sys.argv[1]), *map(int, sys.argv[2:4])
    for index, number in enumerate(range(0, last, step)):
        # Every death is survived by the same folder; every seventh meets an empty one.
        folder = directory / str(index // 7)
        print(json.dumps(one(folder, number, 1 + 2 * SAVES * index)), flush=True)


if __name__ == "__main__":
    main()
