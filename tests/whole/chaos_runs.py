"""Long chaos on real processes: `make chaos` and `make chaos-pairs`.

    python -m tests.whole.chaos_runs [ways] [routers] [leaks] [pairs] [--seed N] [--rate R]

ways     every process in every way, in one mission
routers  the two routers 50 times
leaks    200 deaths in ten minutes, and whether anything that the run holds grows
pairs    every pair of processes at once, in the middle of missions; those with the
         supervisor or the root in all combinations of ways

Without a name, the first three run, about half an hour. One line is printed for each strike, and a
summary. Exit code 1 if anything was not as it has to be. Pairs and missions are kept as lines of
JSON: an interrupted session of pairs continues with the same command. Other load on the machine is
part of what is tested, so keep it moderate.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import statistics
import sys
import tempfile
import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rampart.actors.bus.run_folder import ROUTERS
from rampart.actors.osmosis.airport.formats import load_airport
from rampart.actors.runtime.run_plan import SUPERVISOR
from rampart.manager.spec.specification import SystemSpec, check_document, read_document
from rampart.testing import RealRun, free_base_port
from tests import ROOT
from tests.whole.chaos import (
    ROOT_PROCESS,
    Chaos,
    Strike,
    Struck,
    complaints,
    each_in_every_way,
    every_pair,
    so_many,
    targets,
)
from tests.whole.leak_counts import count, leaks, shared_memory

SYSTEM = ROOT / "systems" / "osmosis.toml"
SETTLE_S = 8.0
"""Wall seconds of quiet before a count that others are compared with."""

BREATH_S = 0.3
"""Wall seconds between everything being back and the next pair."""

ROUTER_HITS = 50
DEATHS = 200
MINUTES = 10.0
LAPS = 3
ROWS = ("A", "B")
MISSION_S = 1200.0

Record = dict[str, Any]


def load() -> SystemSpec:
    """Return the full system."""
    return check_document(read_document(SYSTEM.read_text(encoding="utf-8"), SYSTEM.name),
                          SYSTEM.name)


def start(directory: Path, mission: Path, rate: float, *arguments: str) -> RealRun:
    """Return a run of the full system with the operator's page, not yet begun."""
    directory.mkdir(parents=True)
    return RealRun(directory, SYSTEM, "--mission", str(mission), "--rate", f"{rate:g}",
                   "--hmi-port", str(free_base_port()), "--patience", "90", *arguments, hmi=True)


def write_laps(directory: Path, laps: int = LAPS) -> Path:
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


def ways(root: Path, seed: int, rate: float) -> list[str]:
    """Hit every process in every way during one mission; return what was wrong."""
    strikes = each_in_every_way(targets(load()), seed, (2.0 / rate, 5.0 / rate))
    return _in_one_mission("ways", root, rate, strikes, LAPS)


def routers(root: Path, seed: int, rate: float) -> list[str]:
    """Hit the two routers in turn during one mission; return what was wrong."""
    strikes = so_many(ROUTERS, ROUTER_HITS, seed, (1.0 / rate, 4.0 / rate))
    return _in_one_mission("routers", root, rate, strikes, 0)


def _in_one_mission(name: str, root: Path, rate: float, strikes: Sequence[Strike], laps: int
                    ) -> list[str]:
    with start(root / name, write_laps(root, laps), rate) as run:
        run.wait_for("goal 1/")
        chaos = Chaos(run, say)
        left = chaos.carry_out(strikes)
        code, result = run.result(MISSION_S)
    wrong = complaints(run, code, result, ROWS, chaos.struck)
    if left:
        wrong.append(f"{len(left)} strikes of {len(strikes)} were left when the mission ended")
    return _concluded(name, run, chaos.struck, result, wrong)


def deaths(root: Path, seed: int, rate: float) -> list[str]:
    """Let many processes die in ten minutes of one run; return what was wrong or has leaked."""
    everything = targets(load())
    survivors = (SUPERVISOR, *(name for name in everything.paused if name != ROOT_PROCESS))
    names = [name for name in everything.mortal if name not in survivors]
    period_s = 60 * MINUTES / DEATHS
    strikes = so_many(names, DEATHS, seed, (0.5 * period_s, 1.1 * period_s))
    memory_before = shared_memory()
    with start(root / "leaks", write_laps(root), rate) as run:
        run.wait_for("goal 1/")
        time.sleep(SETTLE_S)
        before = after = count(run, survivors)
        say(f"before: {before}")
        chaos, begun_s = Chaos(run, say), time.monotonic()
        chaos.carry_out(strikes)
        took_s = time.monotonic() - begun_s
        if run.process.poll() is None:
            time.sleep(SETTLE_S)
            after = count(run, survivors)
            say(f"after: {after}")
        code, result = run.result(MISSION_S)
    wrong = complaints(run, code, result, ROWS, chaos.struck) + leaks(before, after)
    if len(chaos.struck) < DEATHS or took_s > 60 * MINUTES:
        wrong.append(f"{len(chaos.struck)} of {DEATHS} deaths in {took_s:.0f} s")
    wrong += [f"shared memory: {name}" for name in sorted(shared_memory(run.port) - memory_before)]
    if f"rampart.{run.port}." in Path("/proc/net/unix").read_text(encoding="utf-8"):
        wrong.append("a unix socket is left")
    return _concluded("leaks", run, chaos.struck, result, wrong)


def _concluded(name: str, run: RealRun, struck: Sequence[Struck], result: Record,
               wrong: list[str]) -> list[str]:
    say(f"{name}: {len(struck)} strikes, {result['mission']}, {result['safety']}, "
        f"{result['duration_s']} s simulated; back after {spread(d.back_s for d in struck)}")
    if wrong:
        say(run.story)
    return [f"{name}: {line}" for line in wrong]


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
    verdict = {key: result[key] for key in ("mission", "safety", "duration_s", "reasons")}
    wrong = complaints(run, code, result, lights, [])
    log.add("mission", **verdict, wrong=wrong, resets=chaos.resets, pairs=len(chaos.struck),
            story=run.story if wrong else "")
    say(f"mission: {result['mission']}, {result['safety']}, after {len(chaos.struck)} pairs and "
        f"{chaos.resets} resets" + "".join(f"\n  {line}" for line in wrong))


def pairs(root: Path, seed: int, rate: float, file: Path) -> list[str]:
    """Hit every pair that the log has not; return what was wrong with any of them."""
    log = Log(file, seed)
    done = {record["index"] for record in log.of("pair")}
    todo = {i: pair for i, pair in enumerate(every_pair(targets(load()), seed)) if i not in done}
    while todo:
        name = f"pairs{len(log.of('mission'))}"
        pairs_in_a_mission(start(root / name, write_laps(root, 1), rate),
                           todo, log)
    hit, missions = log.of("pair"), log.of("mission")
    say(f"{len(hit)} pairs in {len(missions)} missions: "
        f"{sum(m['safety'] == 'safe' for m in missions)} safe, "
        f"{sum(m['mission'] == 'success' for m in missions)} successful, "
        f"{sum(m['resets'] for m in missions)} resets of the emergency stop; everything back after "
        f"{spread(p['back_s'] for p in hit)}; others replaced as well after "
        f"{sum(bool(p['others']) for p in hit)}")
    return [*(f"pair #{p['index']}: {p['missing']}\n{p['story']}" for p in hit
              if p["back_s"] is None),
            *(f"mission {i}: {line}" for i, m in enumerate(missions, 1) for line in m["wrong"])]


def spread(seconds: Iterable[float | None]) -> str:
    """Return median, 95th percentile and maximum in milliseconds."""
    known = sorted(s for s in seconds if s is not None)
    if len(known) < 2:
        return "too few to tell"
    percentile = statistics.quantiles(known, n=20, method="inclusive")[-1]
    return (f"median {1e3 * statistics.median(known):.0f} ms, 95 % within {1e3 * percentile:.0f} "
            f"ms, at most {1e3 * known[-1]:.0f} ms ({len(known)})")


def main() -> int:
    """Run what was asked for and return the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", nargs="*", metavar="NAME",
                        help="ways, routers, leaks, pairs (default: the first three)")
    parser.add_argument("--seed", type=int, default=1, help="of the plan (default: 1)")
    parser.add_argument("--rate", type=float, default=1.0, help="simulated seconds per second")
    parser.add_argument("--file", type=Path, default=Path("reports/chaos-pairs.jsonl"),
                        help="JSON lines of pairs (default: %(default)s)")
    options = parser.parse_args()
    known = {"ways": ways, "routers": routers, "leaks": deaths}
    if unknown := set(options.what) - {*known, "pairs"}:
        parser.error(f"{', '.join(unknown)}: expected {', '.join(known)} or pairs")
    wrong: list[str] = []
    with tempfile.TemporaryDirectory() as directory:
        for name in options.what or known:
            wrong += (known[name](Path(directory), options.seed, options.rate) if name in known else
                      pairs(Path(directory), options.seed, options.rate, options.file))
    for line in wrong:
        say(f"WRONG {line}")
    say("all as it has to be" if not wrong else f"{len(wrong)} things are wrong")
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
