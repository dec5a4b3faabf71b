"""Missions with an overload of the machine on the way, `make overload`.

`python -m tests.whole.overload_runs [--tries N] [--seconds S] [--only KIND]`: a line for each try,
a row for each kind; exit code 1 if a mission was not completed
or not safe. A try takes 40 to 90 s.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path
from statistics import median

from tests.whole.overload import LOADS, Outcome, drive

_GOOD = "success", "safe"


def row(kind: str, found: list[Outcome]) -> str:
    """Return the row of a kind."""
    went_on = sum(one.mission == "success" for one in found)
    safe = sum(one.safety == "safe" for one in found)
    return (f"| {kind} | {went_on} of {len(found)} | {safe} of {len(found)} "
            f"| {sum(one.stopped for one in found)} "
            f"| {median(one.decisions for one in found):g} ({max(o.decisions for o in found)}) "
            f"| {median(one.restarts for one in found):g} ({max(o.restarts for o in found)}) "
            f"| {max(one.late_s for one in found):.2f} s |")


def main() -> int:
    """Drive them; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tries", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--only", choices=LOADS)
    options = parser.parse_args()
    rows, good = [], True
    for kind in [options.only] if options.only else LOADS:
        found = []
        for number in range(options.tries):
            with tempfile.TemporaryDirectory() as folder:
                one, story = drive(Path(folder), kind, options.seconds)
            print(f"{kind} {number + 1}: {one}", flush=True)
            if (one.mission, one.safety) != _GOOD:
                print(story, flush=True)
            found.append(one)
        rows.append(row(kind, found))
        good = good and all((o.mission, o.safety) == _GOOD for o in found)
    print("| overload | mission completed | safe | taken for one | decisions, median (most) "
          "| restarts, median (most) | latest loop |", "|---|---|---|---|---|---|---|", *rows,
          sep="\n")
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
