"""Long chaos on real processes: `make chaos` and `make chaos-pairs`.

    python -m tests.whole.chaos_runs ways [--seed N] [--rate R]
    python -m tests.whole.chaos_runs pairs [--seed N] [--rate R] [--file FILE]

ways     every process in every way in one mission, and then routers 50 times; nothing that the run
         holds may have grown
pairs    every pair of processes at once, in the middle of missions; those with the supervisor or
         the root in all combinations of ways

One line is printed for each strike, and a summary. Exit code 1 if anything was not as it has to be.
Pairs and missions are kept as lines of JSON: an interrupted session of pairs continues with the
same command. Other load on the machine is part of what is tested, so keep it moderate.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import random
import statistics
import sys
import tempfile
import time
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rampart.actors.bus.run_folder import ROUTERS
from rampart.actors.osmosis.airport.formats import load_airport
from rampart.actors.supervision.process_title import RUN
from rampart.manager.spec.specification import SystemSpec, parse_specification
from rampart.testing import RealRun, free_base_port
from tests import ROOT
from tests.whole.chaos import (
    WAYS,
    Chaos,
    Hit,
    Strike,
    complaints,
    each_in_every_way,
    every_pair,
    targets,
)
from tests.whole.leak_counts import count, leaks

SYSTEM = ROOT / "systems" / "osmosis.toml"
SETTLE_S = 8.0
"""Wall seconds of quiet before a count that others are compared with."""

BREATH_S = 0.3
"""Wall seconds between everything being back and the next pair."""

ROUTER_HITS = 50
LAPS = 4
ROWS = ("A", "B")
MISSION_S = 1200.0

Record = dict[str, Any]


def load() -> SystemSpec:
    """Return the full system."""
    return parse_specification(SYSTEM.read_text(encoding="utf-8"), SYSTEM.name)


def start(directory: Path, mission: Path, rate: float, *arguments: str) -> RealRun:
    """Return a run of the full system with the operator's page, not yet begun."""
    directory.mkdir(parents=True)
    return RealRun(directory, SYSTEM, "--mission", str(mission), "--rate", f"{rate:g}",
                   "--hmi-port", str(free_base_port()), "--patience", "90", *arguments, hmi=True)


def write_laps(directory: Path, laps: int) -> Path:
    """Write mission AB and then its way again and again, without looking at the lights."""
    goals = load_airport("vallombre").missions["AB"].goals
    lines = [f"x={g.x_m},y={g.y_m},taxi={int(lap > 0 or g.mode == 'taxi')}"
             for lap in range(laps + 1) for g in goals]
    file = directory / "LAPS.miss"
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return file


def say(line: object) -> None:
    """Print a line at once."""
    print(line, flush=True)


class Log:
    """A file of JSON lines of one seed: what was done, so that an interrupted session continues."""

    def __init__(self, file: Path, seed: int) -> None:
        self.records: list[Record] = []
        self._file = file
        self._seed = seed
        written = file.read_text(encoding="utf-8") if file.exists() else ""
        for line in written.splitlines():
            with contextlib.suppress(json.JSONDecodeError):  # cut off by an interruption
                self.records.append(json.loads(line))
        if any(record["seed"] != seed for record in self.records):
            raise SystemExit(f"{file}: of another seed than {seed}; choose another --file")
        if written and not written.endswith("\n"):
            self._append("\n")

    def add(self, kind: str, **fields: Any) -> None:
        """Keep a record, also on disk."""
        record = {"kind": kind, "seed": self._seed, **fields}
        self.records.append(record)
        self._append(json.dumps(record) + "\n")

    def of(self, kind: str) -> list[Record]:
        """Return the records of a kind."""
        return [record for record in self.records if record["kind"] == kind]

    def _append(self, text: str) -> None:
        self._file.parent.mkdir(parents=True, exist_ok=True)
        with self._file.open("a", encoding="utf-8") as out:
            out.write(text)


def ways(root: Path, options: argparse.Namespace) -> list[str]:
    """Hit every process in every way during one mission, then routers; return what was wrong."""
    dice = random.Random(f"routers {options.seed}")
    strikes = each_in_every_way(targets(load()), options.seed, (2.0, 5.0))
    strikes += [Strike((Hit(ROUTERS[i % 2], dice.choice(WAYS)),), dice.uniform(1.0, 4.0))
                for i in range(ROUTER_HITS)]
    with start(root / "ways", write_laps(root, LAPS), options.rate) as run:
        run.wait_for("goal 1/")
        time.sleep(SETTLE_S)
        before = after = count(run, ("simulator", RUN))
        chaos = Chaos(run, say)
        left = chaos.carry_out(strikes)
        if not left:
            time.sleep(SETTLE_S)
            after = count(run, ("simulator", RUN))
        say(f"before: {before}\nafter:  {after}")
        code, result = run.result(MISSION_S)
    say(f"{len(chaos.struck)} strikes, {result['mission']}, {result['safety']}, "
        f"{result['duration_s']} s simulated; back after {spread(d.back_s for d in chaos.struck)}")
    wrong = [*(f"not back: {one}" for one in chaos.struck if one.back_s is None),
             *complaints(code, result, run.story, ROWS), *leaks(before, after),
             *(f"was left when the mission ended: {one}" for one in left)]
    return [*wrong, run.story] if wrong else []


def pairs_in_a_mission(run: RealRun, todo: dict[int, Strike], log: Log,
                       lights: tuple[str, ...] = ROWS) -> None:
    """Hit pairs as long as a run's mission lasts; what is done is kept and taken from `todo`."""
    with run:
        run.wait_for("goal 1/", 60)
        chaos = Chaos(run)
        for index, strike in list(todo.items()):
            struck = chaos.strike(strike, everything=True)
            if struck is None:
                break
            del todo[index]
            log.add("pair", index=index, **asdict(struck))
            say(f"#{index:<4d} {struck}  ({len(todo)} left)")
            chaos.release()
            time.sleep(BREATH_S)
            if chaos.over():
                break
        code, result = run.result(MISSION_S)
    verdict = {key: result[key] for key in ("mission", "safety", "duration_s")}
    wrong = complaints(code, result, run.story, lights)
    log.add("mission", **verdict, wrong=wrong, resets=chaos.resets,
            story=run.story if wrong else "")
    say(f"mission: {verdict} after {len(chaos.struck)} pairs and {chaos.resets} resets"
        + "".join(f"\n  {line}" for line in wrong))


def pairs(root: Path, options: argparse.Namespace) -> list[str]:
    """Hit every pair that the log has not; return what was wrong with any of them."""
    log = Log(options.file, options.seed)
    done = {record["index"] for record in log.of("pair")}
    todo = {i: pair for i, pair in enumerate(every_pair(targets(load()), options.seed))
            if i not in done}
    while todo:
        name = f"pairs{len(log.of('mission'))}"
        pairs_in_a_mission(start(root / name, write_laps(root, 1), options.rate), todo, log)
    hit, missions = log.of("pair"), log.of("mission")
    say(f"{len(hit)} pairs in {len(missions)} missions: "
        f"{sum(m['safety'] == 'safe' for m in missions)} safe, "
        f"{sum(m['mission'] == 'success' for m in missions)} successful, "
        f"{sum(m['resets'] for m in missions)} resets of the emergency stop; everything back after "
        f"{spread(p['back_s'] for p in hit)}")
    return [*(f"pair #{p['index']}: {p['missing']}" for p in hit if p["back_s"] is None),
            *(f"mission {i}: {line}" for i, m in enumerate(missions, 1) for line in m["wrong"])]


def spread(seconds: Iterable[float | None]) -> str:
    """Return median and maximum in milliseconds."""
    known = [s for s in seconds if s is not None]
    if not known:
        return "nothing"
    return (f"median {1e3 * statistics.median(known):.0f} ms, at most {1e3 * max(known):.0f} ms "
            f"({len(known)})")


def main() -> int:
    """Run what was asked for and return the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("ways", "pairs"))
    parser.add_argument("--seed", type=int, default=1, help="of the plan (default: 1)")
    parser.add_argument("--rate", type=float, default=1.0, help="simulated seconds per second")
    parser.add_argument("--file", type=Path, default=Path("reports/chaos-pairs.jsonl"),
                        help="JSON lines of pairs (default: %(default)s)")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as directory:
        wrong = (ways if options.what == "ways" else pairs)(Path(directory), options)
    for line in wrong:
        say(f"WRONG {line}")
    say("all as it has to be" if not wrong else f"{len(wrong)} things are wrong")
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
