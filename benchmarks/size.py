"""What a system costs by its size: start, memory, processor time, restart of a node.

Starts systems of 10, 35, 70 and 140 processes, one after the other; every node publishes at 20 Hz
and subscribes to two others. Memory is PSS and USS of /proc/PID/smaps_rollup, the mean of all
processes. The start is from the command until all processes run.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import psutil

from benchmarks.restarts import spread
from benchmarks.systems import BESIDES, sized_system
from rampart.actors.supervision.process_title import find_processes
from rampart.cli.output import print_json, print_table
from rampart.testing import RealRun

os.environ["PYTHONPATH"] = str(Path(__file__).resolve().parents[1])  # for the actors
SETTLE_S, REST_S = 2.0, 5.0


def measure(processes: int, kills: int) -> dict[str, object]:
    """Return the row of a system of so many processes."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "system.toml"
        file.write_text(sized_system(processes), encoding="utf-8")
        begun_s = time.monotonic()
        with RealRun(Path(folder), file) as run:
            run.wait_until(lambda: len(find_processes(run.port)) >= processes - 1, 60, "no start")
            start_s = time.monotonic() - begun_s
            time.sleep(SETTLE_S)
            everyone = [psutil.Process(run.process.pid),
                        *(psutil.Process(one.pid) for one in find_processes(run.port))]
            before = sum(sum(one.cpu_times()[:2]) for one in everyone)
            time.sleep(REST_S)
            cores = (sum(sum(one.cpu_times()[:2]) for one in everyone) - before) / REST_S
            memory = [one.memory_full_info() for one in everyone]
            done = subprocess.run(
                [sys.executable, "-m", "benchmarks.restarts", "--port", str(run.port),
                 "--node", f"n{(processes - BESIDES) // 2}", "--kills", str(kills), "--json"],
                check=True, capture_output=True, text=True)
    mean = 1e6 * len(memory)
    return {"processes": len(everyone), "start_s": round(start_s, 2),
            "pss_mb": round(sum(one.pss for one in memory) / mean, 1),
            "uss_mb": round(sum(one.uss for one in memory) / mean, 1), "cores": round(cores, 3),
            "output": spread(json.loads(done.stdout)[0]["output_ms"])}


def main() -> int:
    """Measure each size, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sizes", nargs="*", type=int, default=[10, 35, 70, 140], metavar="N",
                        help=f"processes, more than {BESIDES + 2} (default: 10 35 70 140)")
    parser.add_argument("--kills", type=int, default=12, metavar="N", help="of a node in each")
    parser.add_argument("--json", action="store_true", help="print JSON")
    options = parser.parse_args()
    rows = [measure(processes, options.kills) for processes in options.sizes]
    if options.json:
        print_json(rows)
    else:
        print_table(list(rows[0]), [[
            f"{cell.median} ({cell.low} to {cell.high})" if hasattr(cell, "median") else cell
            for cell in row.values()] for row in rows])
    return 0


if __name__ == "__main__":
    sys.exit(main())
