"""How soon `rampart-stop` says zero after its sender is killed, and how regular its output is.

    python -m benchmarks.zero [--kills 100]

A process sends a velocity at 20 Hz and is killed with SIGKILL at a random moment. The time runs
from the kill to the stamp of the first zero. Prints median, 95 % and maximum, ms, of these times,
and of the deviation of the output from its period.
"""

from __future__ import annotations

import argparse
import itertools
import random
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from tests.stop.stopper import PERIOD_MS, TIMEOUT_MS, compiled, running

SENDER = """
import socket, sys, time
from rampart.actors.foreign.velocity_link import frame
link, session = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM), time.monotonic_ns()
for sequence in range(1, 10**6):
    link.sendto(frame(session, sequence, time.monotonic_ns(), (0.5, 0, 0)), sys.argv[1])
    time.sleep(0.05)
"""


def row(title: str, values: Sequence[float]) -> str:
    """Return a line of the result; values are ms."""
    high = statistics.quantiles(values, n=20)[-1]
    return f"{title:24} {statistics.median(values):8.2f} {high:8.2f} {max(values):8.2f}"


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--kills", type=int, default=100)
    kills = parser.parse_args().kills
    zero_ms: list[float] = []
    jitter_ms: list[float] = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with running(compiled(folder), folder) as stopper:
            for _ in range(kills):
                sender = subprocess.Popen([sys.executable, "-c", SENDER, stopper.into])
                while not stopper.speed:
                    pass
                time.sleep(random.uniform(0, 0.05))
                killed_ns = time.monotonic_ns()
                sender.kill()
                frames = [stopper.next()]
                while frames[-1].stamp_ns < killed_ns or any(frames[-1].velocity):
                    frames.append(stopper.next())
                sender.wait()
                zero_ms.append((frames[-1].stamp_ns - killed_ns) / 1e6)
                jitter_ms += [
                    abs((b.stamp_ns - a.stamp_ns) / 1e6 - PERIOD_MS * (b.sequence - a.sequence))
                    for a, b in itertools.pairwise(frames)]
    print(f"timeout {TIMEOUT_MS} ms, period {PERIOD_MS} ms, {kills} kills")
    print(f"{'ms':24} {'median':>8} {'95 %':>8} {'most':>8}")
    print(row("from the kill to zero", zero_ms))
    print(row("jitter of the output", jitter_ms))


if __name__ == "__main__":
    main()
