"""How much processor time does the whole system take, launcher and simulator included?

Runs `launch.py` with the arguments after `--`, samples the processor time of all processes of the
run once a second, and prints the average in cores from the start of the mission to its end, the
largest consumers, and the result. Example: `python -m benchmarks.processor_time -- --rate 4`.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path

import psutil

from rampart.actors.supervision.process_title import find_processes

ROOT = Path(__file__).resolve().parents[1]
PORT = 8450


def main() -> int:
    """Run, sample, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("arguments", nargs="*", metavar="ARGUMENT", help="of launch.py, after --")
    arguments = parser.parse_args().arguments
    run = subprocess.Popen(
        [sys.executable, str(ROOT / "launch.py"), "--no-hmi", "--json", "--port", str(PORT),
         *arguments], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    used: dict[str, float] = {}
    last: dict[int, float] = {}
    start = time.monotonic()
    root = psutil.Process(run.pid)
    while run.poll() is None:
        names = {p.pid: "+".join(p.names) for p in find_processes(PORT)} | {run.pid: "launch.py"}
        for process in [root, *root.children(recursive=True)]:
            pid = process.pid
            try:
                name = names.get(pid) or process.cmdline()[0].partition(" ")[0]
                times = process.cpu_times()
            except (psutil.Error, IndexError):
                continue
            total = times.user + times.system
            # The first sample of a process is its past: the imports, which its fork inherits not.
            if pid in last:
                used[name] = used.get(name, 0.0) + total - last[pid]
            last[pid] = total
        time.sleep(1.0)
    elapsed = time.monotonic() - start
    assert run.stdout is not None
    result = json.loads(run.stdout.read().splitlines()[-1])
    print(f"{sum(used.values()) / elapsed:.3f} cores on average over {elapsed:.0f} s")
    for name, seconds in sorted(used.items(), key=lambda item: -item[1])[:8]:
        print(f"  {name:<18} {100 * seconds / elapsed:5.1f} % of a core")
    faulty = [light["name"] for light in result["lights"] if light["verdict"] in ("dim", "out")]
    print(f"mission {result['mission']}, {result['safety']}, {result['duration_s']} s simulated, "
          f"{len(result['decisions'])} decisions, faulty lights: {' '.join(faulty)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
