"""How fast is the whole controller in virtual time? `python -m benchmarks.virtual_speed [RUNS]`.

Mission A on the shipped airport with seed 1, again and again in one process, of the paper's system
and of the full one in turn; prints, for each run, processor time, simulated seconds per second of
it, messages and trace. A first run of each, which also imports and loads, is left out.
"""

from __future__ import annotations

import argparse
import statistics
import time

from rampart.sim.campaign.job import Job, run_virtually

RUNS = 4
SYSTEMS = ("paper", "osmosis")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", nargs="?", type=int, default=RUNS, metavar="RUNS",
                        help=f"of each system (default: {RUNS})")
    runs = parser.parse_args().runs
    jobs = {name: Job(row="none", system=name, options={"mission": "A"}) for name in SYSTEMS}
    speeds: dict[str, list[float]] = {name: [] for name in SYSTEMS}
    for job in jobs.values():
        run_virtually(job)  # imports, compiles, loads the map
    for _ in range(runs):
        for name, job in jobs.items():
            begun_s = time.process_time()
            result = run_virtually(job)
            took_s = time.process_time() - begun_s
            speeds[name].append(result.record.duration_s / took_s)
            print(f"{name}: {took_s:.2f} s, {speeds[name][-1]:.1f} times real time, "
                  f"{result.messages} messages, trace {result.trace[:12]}", flush=True)
    for name, seen in speeds.items():
        print(f"{name}: median {statistics.median(seen):.1f}, {min(seen):.1f} to {max(seen):.1f}")


if __name__ == "__main__":
    main()
