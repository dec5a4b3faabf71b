"""How much processor time does the black box cost?

Starts the full system without one, then attaches a black box for some seconds, detaches it, and so
on. Both halves of a pair are of one run and follow each other, in changing order, so the mission
and the load of the machine affect them alike. Prints the cores of each half, with the share of the
black box, and the mean and the standard error of the differences. Processor time is what the
scheduler counts, in nanoseconds. Example: `python -m benchmarks.black_box`.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import psutil

from rampart.actors.bus.run_info import ask
from rampart.actors.recording.process import Order, record
from rampart.actors.recording.run_listener import RUN_ENDED
from rampart.manager.spec.tables import BlackBox

ROOT = Path(__file__).resolve().parents[1]
PORT = 8460
SETTLING_S = 10.0
CHANGING_S = 1.5


def used_s(root: psutil.Process) -> dict[int, float]:
    """Return the processor time of the run's processes and of this one's children, by pid."""
    found: dict[int, float] = {}
    for process in {root, *root.children(recursive=True), *psutil.Process().children()}:
        with contextlib.suppress(OSError):
            found[process.pid] = sum(
                int(task.read_text().split()[0]) / 1e9
                for task in Path(f"/proc/{process.pid}/task").glob("*/schedstat"))
    return found


def cores(root: psutil.Process, seconds: float, box: int = 0) -> tuple[float, float]:
    """Return the cores that all processes, and the black box, use in some seconds."""
    before, begun_s = used_s(root), time.monotonic()
    time.sleep(seconds)
    after, lasted_s = used_s(root), time.monotonic() - begun_s
    used = {pid: after[pid] - before[pid] for pid in after.keys() & before.keys()}
    return sum(used.values()) / lasted_s, used.get(box, 0.0) / lasted_s


@contextlib.contextmanager
def black_box(order: Order) -> Iterator[int]:
    """Provide a black box; yield its pid once nodes hand over their messages."""
    pid = os.fork()
    if pid == 0:
        os._exit(record(order))
    try:
        time.sleep(CHANGING_S)
        yield pid
    finally:
        os.kill(pid, RUN_ENDED)
        os.waitpid(pid, 0)
        time.sleep(CHANGING_S)


def main() -> int:
    """Run, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pairs", type=int, default=10)
    parser.add_argument("--seconds", type=float, default=3.0, help="of each half of a pair")
    options = parser.parse_args()
    signal.signal(RUN_ENDED, signal.SIG_IGN)
    with tempfile.TemporaryDirectory() as folder:
        run = subprocess.Popen(
            [sys.executable, str(ROOT / "launch.py"), "--no-hmi", "--no-black-box", "--mission",
             "A", "--port", str(PORT), "--report", f"{folder}/report"],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        time.sleep(SETTLING_S)
        info = ask(PORT)
        assert info is not None
        root, differences, means = psutil.Process(run.pid), [], []
        order = Order(PORT, f"{folder}/osmosis", info.pid, black_box=BlackBox())
        for number in range(options.pairs):
            without = cores(root, options.seconds)[0] if number % 2 else 0.0
            with black_box(order) as pid:
                with_it, own = cores(root, options.seconds, pid)
            without = without or cores(root, options.seconds)[0]
            differences.append(with_it - without)
            means.append(without)
            print(f"{without:.3f} cores without, {with_it:.3f} with, of which it used {own:.4f}",
                  flush=True)
        run.terminate()
        run.wait()
    mean, base = statistics.mean(differences), statistics.mean(means)
    error = statistics.stdev(differences) / math.sqrt(len(differences))
    print(f"difference {mean:.4f} ± {error:.4f} cores, {100 * mean / base:.1f} ± "
          f"{100 * error / base:.1f} % of {base:.3f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
