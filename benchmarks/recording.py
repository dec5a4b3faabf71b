"""What does it cost to record everything, and is anything lost?

Runs mission AB twice for the same time, the first time recorded (`launch.py --record`), and prints:
processor time of the recorder as a share of a core; messages written, and the gaps in the sequence
numbers, source by source (a gap is a message that was sent and not recorded); processor time of the
robot's own processes with and without a recorder. Example:
`python -m benchmarks.recording --seconds 60`.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import psutil

from rampart.actors.recording.bag_reader import BagReader, Summary
from rampart.actors.supervision.process_title import find_processes

ROOT = Path(__file__).resolve().parents[1]
PORT = 8650
WARM_UP_S = 8.0
"""Until all processes are there and have loaded."""


def main() -> int:
    """Run twice, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=60.0, help="measured in each run")
    parser.add_argument("--rate", type=float, default=1.0, help="of the run")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory) / "run.mcap"
        recorder, robot_recorded = measure(options.seconds, options.rate, directory, path)
        summary = Summary(BagReader(path))
        lost = json.loads(summary.end["lost"])
        print(f"recorder   {100 * recorder:.1f} % of a core")
        print(f"written    {summary.end['messages']} messages and "
              f"{summary.messages - int(summary.end['messages'])} views in "
              f"{summary.duration_s:.0f} s, {int(summary.end['messages']) / summary.duration_s:.0f}"
              f" messages a second, {summary.reader.size_bytes / 1e6 / summary.duration_s * 60:.1f}"
              " MB a minute")
        print(f"lost       {sum(lost.values())} {lost or ''}")
        _, robot = measure(options.seconds, options.rate, directory, None)
        print(f"robot      {100 * robot_recorded:.1f} % of a core recorded, "
              f"{100 * robot:.1f} % not recorded")
    return 0


def measure(seconds: float, rate: float, directory: str, record: Path | None
            ) -> tuple[float, float]:
    """Return shares of a core: of the recorder, and of all the robot's processes together."""
    arguments = ["--record", str(record)] if record else []
    run = subprocess.Popen(
        [sys.executable, str(ROOT / "launch.py"), "--no-hmi", "--port", str(PORT), "--rate",
         f"{rate:g}", "--report", directory, *arguments],
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        time.sleep(WARM_UP_S)
        recorders = {child.pid for child in psutil.Process(run.pid).children()
                     if "rampart-recorder" in " ".join(child.cmdline())}
        first: dict[int, float] = {}
        last: dict[int, float] = {}
        begun_s = time.monotonic()
        while (elapsed_s := time.monotonic() - begun_s) < seconds:
            for pid in {*recorders, run.pid, *(p.pid for p in find_processes(PORT))}:
                with contextlib.suppress(psutil.Error):
                    times = psutil.Process(pid).cpu_times()
                    last[pid] = times.user + times.system
                    first.setdefault(pid, last[pid])
            time.sleep(1.0)
    finally:
        run.send_signal(signal.SIGTERM)
        run.wait()
    shares = {pid: (last[pid] - first[pid]) / elapsed_s for pid in last}
    recorder = sum(share for pid, share in shares.items() if pid in recorders)
    return recorder, sum(shares.values()) - recorder


if __name__ == "__main__":
    sys.exit(main())
