"""Every pair of processes of the full system, hit in the middle of missions: `make chaos-pairs`.

One pair after the other, one mission after the other, in the order that follows from the seed; the
guards' pairs in all combinations of ways. One line for each pair and each mission, the same as JSON
lines in a file, and a summary. What is in the file is not done again: an interrupted session goes
on with the same command. Exit code 1 if anything was not as it has to be.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import tempfile
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from rampart.testing import RealRun
from tests.whole.chaos import complaints, targets
from tests.whole.chaos_pairs import Pair, PairChaos, plan_pairs
from tests.whole.chaos_runs import load, say, start, write_laps

BREATH_S = 0.3
"""Wall seconds between everything being back and the next pair."""

LAPS = 1
MISSION_S = 900.0


class Log:
    """The file of JSON lines: pairs and missions that were done."""

    def __init__(self, file: Path, seed: int) -> None:
        self._file = file
        self.pairs: dict[int, dict[str, Any]] = {}
        self.missions: list[dict[str, Any]] = []
        for line in file.read_text(encoding="utf-8").splitlines() if file.exists() else ():
            record = json.loads(line)
            if record.get("seed") != seed:
                raise SystemExit(f"{file}: of seed {record.get('seed')}, not {seed}; "
                                 "choose another --file")
            self._keep(record)
        self._seed = seed

    def add(self, record: dict[str, Any]) -> None:
        """Keep a record, on disk too."""
        record = {"seed": self._seed, **record}
        with self._file.open("a", encoding="utf-8") as out:
            out.write(json.dumps(record) + "\n")
        self._keep(record)

    def _keep(self, record: dict[str, Any]) -> None:
        if "mission" in record:
            self.missions.append(record)
        else:
            self.pairs[record["index"]] = record


def one_mission(directory: Path, todo: Sequence[Pair], log: Log, rate: float, total: int,
                *, mission: str = "", rows: str = "AB") -> list[Pair]:
    """Hit pairs as long as a mission lasts, and keep what came of it; return the pairs left."""
    left = list(todo)
    with start(directory, mission or str(write_laps(directory.parent, LAPS)), rate) as run:
        run.wait_for("goal 1/", 60)
        chaos = PairChaos(run, targets(load()).world)
        while left and not chaos.over():
            begun_s = time.monotonic()
            outcome = chaos.strike(left[0])
            if outcome is None:
                break
            log.add({**outcome.record, "took_s": round(time.monotonic() - begun_s, 3)})
            say(f"{len(log.pairs):4d} of {total}  #{outcome.pair.index:<4d} {outcome}")
            left.pop(0)
            chaos.release()
            time.sleep(BREATH_S)
        log.add({**_ended(run, rows), "pairs": len(todo) - len(left), "resets": chaos.resets})
    verdict = log.missions[-1]
    say(f"mission {len(log.missions)}: {verdict['mission']}, {verdict['safety']}, after "
        f"{verdict['pairs']} pairs and {verdict['resets']} resets in {verdict['duration_s']} s "
        "simulated"
        + "".join(f"\n  {line}" for line in verdict["wrong"]))
    return left


def _ended(run: RealRun, rows: str) -> dict[str, Any]:
    code, result = run.result(MISSION_S)
    wrong = complaints(run, code, result, rows, [])
    if result["mission"] != "success":  # then lights are missing, and that is no news
        wrong = [line for line in wrong if not line.startswith("lights of")]
    return {"mission": result["mission"], "safety": result["safety"],
            "duration_s": result["duration_s"], "reasons": result["reasons"], "wrong": wrong,
            "story": run.story if wrong else ""}


def summary(pairs: Iterable[dict[str, Any]], missions: Sequence[dict[str, Any]]) -> list[str]:
    """Return the figures, and then what was not as it has to be; each a line."""
    pairs = list(pairs)
    back = sorted(p["back_s"] for p in pairs if p["back_s"] is not None)
    lines = [f"{len(pairs)} pairs of {len({frozenset(p['names']) for p in pairs})} different, "
             f"{len(missions)} missions: "
             f"{sum(m['safety'] == 'safe' for m in missions)} safe, "
             f"{sum(m['mission'] == 'success' for m in missions)} successful, "
             f"{sum(m['resets'] for m in missions)} resets of the emergency stop"]
    if len(back) > 1:
        lines.append("everything back after " + ", ".join(
            f"{what} {value:.2f} s" for what, value in (
                ("median", statistics.median(back)),
                ("95th percentile", statistics.quantiles(back, n=20)[-1]), ("max", back[-1]))))
    others = sum(bool(p["others"]) for p in pairs)
    lines.append(f"{others} pairs after which others were replaced as well")
    return [*lines, *wrong(pairs, missions)]


def wrong(pairs: Iterable[dict[str, Any]], missions: Iterable[dict[str, Any]]) -> list[str]:
    """Return what was not as it has to be."""
    found = [f"WRONG pair #{p['index']} {' '.join(p['ways'])} {' '.join(p['names'])}: "
             f"{p['missing']}\n{p['story']}" for p in pairs if p["back_s"] is None]
    return found + [f"WRONG mission {number}: {line}" for number, m in enumerate(missions, 1)
                    for line in m["wrong"]]


def main(arguments: list[str] | None = None) -> int:
    """Run what was asked for and return the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=1, help="of the plan (default: 1)")
    parser.add_argument("--rate", type=float, default=1.0, help="simulated seconds per second")
    parser.add_argument("--start", type=int, default=0, metavar="INDEX",
                        help="first pair of the plan to hit (default: 0)")
    parser.add_argument("--count", type=int, metavar="N", help="so many of the plan, from there")
    parser.add_argument("--file", type=Path, default=Path("reports/chaos-pairs.jsonl"),
                        help="JSON lines of what was done (default: %(default)s)")
    parser.add_argument("--list", action="store_true", help="print the plan and do nothing")
    parser.add_argument("--summary", action="store_true", help="print the summary of the file only")
    options = parser.parse_args(arguments)
    plan = plan_pairs(targets(load()), options.seed)
    if options.list:
        for pair in plan:
            say(f"#{pair.index:<4d} {pair}")
        return 0
    options.file.parent.mkdir(parents=True, exist_ok=True)
    log = Log(options.file, options.seed)
    if not options.summary:
        end = None if options.count is None else options.start + options.count
        todo = [pair for pair in plan[options.start:end] if pair.index not in log.pairs]
        total = len(todo) + len(log.pairs)
        with tempfile.TemporaryDirectory() as directory:
            while todo:
                todo = one_mission(
                    Path(directory) / f"run{len(log.missions)}", todo, log, options.rate, total)
    for line in summary(log.pairs.values(), log.missions):
        say(line)
    return int(bool(wrong(log.pairs.values(), log.missions)))


if __name__ == "__main__":
    sys.exit(main())
