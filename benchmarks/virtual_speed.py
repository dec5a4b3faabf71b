"""How fast is the whole controller in virtual time? `python -m benchmarks.virtual_speed [RUNS]`.

Mission A on the shipped airport with seed 1, again and again in one process; prints, for each run,
processor time, simulated seconds per second of it, messages and trace. A first run, which also
imports and loads, is left out.
"""

from __future__ import annotations

import statistics
import sys
import time

from sim.campaign.job import Job, run_virtually

RUNS = 4


def main() -> None:
    """Measure and print."""
    runs = int(sys.argv[1]) if len(sys.argv) > 1 else RUNS
    job = Job(row="none", system="osmosis", mission="A", seed=1)
    run_virtually(job)  # imports, compiles, loads the map
    speeds = []
    for _ in range(runs):
        begun_s = time.process_time()
        result = run_virtually(job)
        took_s = time.process_time() - begun_s
        speeds.append(result.record.duration_s / took_s)
        print(f"{took_s:.2f} s, {speeds[-1]:.1f} times real time, {result.messages} messages, "
              f"trace {result.trace[:12]}", flush=True)
    print(f"median {statistics.median(speeds):.1f}, {min(speeds):.1f} to {max(speeds):.1f}")


if __name__ == "__main__":
    main()
