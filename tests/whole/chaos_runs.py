"""Long chaos on real processes: `make chaos`, `make chaos-pairs` and `make soak`.

    python -m tests.whole.chaos_runs ways|pairs|soak [--seed N] [--rate R] [--file FILE] [--hours H]

ways     every process in every way in one mission, and then routers 50 times; nothing that the run
         holds may have grown
pairs    every pair of processes at once, in the middle of missions; those with the supervisor or
         the root in all combinations of ways
soak     missions without end, a random fault every five seconds

One line is printed for each strike or mission, and a summary. Exit code 1 if anything was not as it
has to be. What pairs and soak do is kept as lines of JSON: when they were interrupted, the same
command continues. Other load on the machine is part of what is tested, so keep it moderate.

In the soak each process is killed once at first: a process of the pool that has replaced another
has more memory of its own than those that were forked at the start, and after that step it counts
whether memory grows. Then half of the faults hit a process, from outside. The other half are those
of messages, sensors, actuators and the world that the run's injector knows; each is over when the
next one comes. An emergency stop that latches is reset. A mission that fails and is safe is
counted. One that is not safe ends the soak; its report is kept.

A figure grows if the line through it rises by more per hour than what counts, and what it rises by
is more than chance (a correlation above `CLEAR`). Samples of one mission have a level of their own,
so each is compared with the mean of its mission. The first five minutes of a mission are left out:
processes begin as copies of the root, and what they share with it becomes their own as they touch
it.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import random
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import psutil

from rampart.actors.bus.run_folder import ROUTERS
from rampart.actors.osmosis.airport.formats import load_airport
from rampart.actors.supervision.process_title import RUN, find_processes
from rampart.manager.spec.specification import SystemSpec, parse_specification
from rampart.sim.campaign.plan import fault_groups
from rampart.sim.faults.scenario import PlannedFault
from rampart.testing import RealRun, free_base_port
from tests import ROOT
from tests.whole.chaos import (
    ROOT_PROCESS,
    WAYS,
    Chaos,
    Hit,
    Strike,
    Struck,
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

EVERY_S, FIRST_S = 5.0, 10.0
"""Simulated seconds between two faults of a mission, and before the first one."""

LASTS_S = (0.5, 4.0)
SAMPLE_S = 10.0
WARM_UP_S = 300.0
END_WITHIN_S = 60.0
LONGEST_S = 3600.0
"""Simulated seconds of a mission for which faults are planned."""

FIGURES = ("MB of its own", "descriptors", "threads")
ALL = "all"
COUNTS = {ALL: (30.0, 60.0, 20.0), ROOT_PROCESS: (15.0, 6.0, 2.0)}
ONE = (5.0, 6.0, 2.0)
"""How much in an hour counts: of all together, of the root, and of any other process."""

CLEAR = 0.5


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


def plan(spec: SystemSpec, seed: int, mission: int
         ) -> tuple[list[tuple[float, Hit]], list[PlannedFault]]:
    """Return hits of processes by simulated second, and faults of the injector, of a mission."""
    dice = random.Random(f"soak {seed} {mission}")
    of = targets(spec)
    groups = {kind: names for kind, names in fault_groups(spec).items()
              if kind != "process" and names}
    hits, faults = [], []
    first = dice.sample(of.mortal, len(of.mortal))
    for i in range(int((LONGEST_S - FIRST_S) / EVERY_S)):
        at_s = FIRST_S + i * EVERY_S
        if i < len(first):
            hits.append((at_s, Hit(first[i], "KILL")))
        elif dice.random() < 0.5:
            hits.append((at_s, of.hit(dice, dice.choice((*of.mortal, *of.paused)))))
        else:
            names = groups[dice.choice(list(groups))]
            faults.append(PlannedFault(dice.choice(names), at_s,
                                       duration_s=round(dice.uniform(*LASTS_S), 2)))
    return hits, faults


def lasted_s(log: Log) -> float:
    """Return the wall seconds that a soak has lasted, missions that were cut included."""
    return max((r["at_s"] for r in log.records if "at_s" in r), default=0.0)


def usage(run: RealRun) -> dict[str, tuple[float, int, int]]:
    """Return each process's `FIGURES`."""
    used = {}
    for name, pid in {ROOT_PROCESS: run.process.pid, **{
            p.names[0]: p.pid for p in find_processes(run.port)}}.items():
        try:
            process = psutil.Process(pid)
            used[name] = (process.memory_full_info().uss / 1e6, process.num_fds(),
                          process.num_threads())
        except psutil.Error:
            continue  # it has just ended
    return used


def one_mission(directory: Path, log: Log, options: argparse.Namespace) -> bool:
    """Carry out a mission; return whether it was safe. Its directory is kept if not."""
    number = len(log.of("begin"))
    hits, planned = plan(load(), options.seed, number)
    faults = [word for fault in planned for word in ("--fault", fault.text())]
    zero_s = time.monotonic() - lasted_s(log)

    def keep(kind: str, **fields: object) -> None:
        log.add(kind, at_s=round(time.monotonic() - zero_s, 3), mission=number, **fields)

    def hit(struck: Struck) -> None:
        name, way = struck.strike.hits[0].name, struck.strike.hits[0].way
        keep("hit", name=name, way=way, back_s=struck.back_s)

    keep("begin")
    directory.mkdir(parents=True, exist_ok=True)
    with start(directory / "run", write_laps(directory, options.laps), options.rate,
               "--seed", str(options.seed + number), *faults) as run:
        chaos, info, sampled_s, was_cut = Chaos(run, hit), run.info, 0.0, False
        while not (was_cut or chaos.over()):
            into_s = time.monotonic() - info.origin_s
            if hits and into_s * info.rate >= hits[0][0]:
                chaos.release()
                chaos.strike(Strike((hits.pop(0)[1],)))
            if into_s > EVERY_S and time.monotonic() - sampled_s >= SAMPLE_S:
                sampled_s = time.monotonic()
                keep("sample", into_s=round(into_s, 2), used=usage(run))
            was_cut = time.monotonic() - zero_s >= 3600 * options.hours or "UNSAFE" in run.story
            time.sleep(0.1)
        if was_cut:
            run.process.send_signal(signal.SIGTERM)
        try:
            _, result = run.result(END_WITHIN_S)
        except (AssertionError, subprocess.TimeoutExpired) as error:
            result = {"mission": "fail", "safety": "not known", "reasons": [repr(error)]}
    keep("mission", verdict=result["mission"], cut=was_cut, safety=result["safety"],
         reasons=result["reasons"], resets=chaos.resets)
    say(f"mission {number}: {'cut' if was_cut else result['mission']}, {result['safety']}, "
        f"{chaos.resets} resets; {lasted_s(log) / 60:.1f} min of soak")
    if result["safety"] == "safe":
        shutil.rmtree(directory)
    return bool(result["safety"] == "safe")


def rise(samples: Iterable[tuple[int, float, float]], counts: float) -> float:
    """Return by how much a figure grows in an hour; 0 if that is no more than chance, or counts.

    Args:
        samples: Mission, seconds into it, and value.
        counts: By how much in an hour it may grow.
    """
    missions: dict[int, list[tuple[float, float]]] = defaultdict(list)
    for mission, into_s, value in samples:
        if into_s >= WARM_UP_S:
            missions[mission].append((into_s / 3600, value))
    around = []
    for points in missions.values():
        hour, level = (statistics.fmean(column) for column in zip(*points, strict=True))
        around += [(t - hour, value - level) for t, value in points]
    if len({t for t, _ in around}) < 2 or len({value for _, value in around}) < 2:
        return 0.0
    times, values = zip(*around, strict=True)
    slope = statistics.linear_regression(times, values).slope
    is_clear = statistics.correlation(times, values) > CLEAR
    return slope if is_clear and slope > counts else 0.0


def growths(records: Sequence[Record]) -> list[str]:
    """Return which figures grow: of all processes together, of the root, and of the others.

    The two routers count as one: all clients are of one of them, and change over when it is killed.
    """
    samples = [r for r in records if r["kind"] == "sample"]
    names = {name for r in samples for name in r["used"]} - set(ROUTERS)
    found = []
    for what in (ALL, "routers", *sorted(names)):
        for place, counts in enumerate(COUNTS.get(what, ONE)):
            values = []
            for r in samples:
                members = {ALL: r["used"], "routers": ROUTERS}.get(what, (what,))
                if r["used"].keys() >= set(members):
                    values.append((r["mission"], r["into_s"],
                                   sum(r["used"][name][place] for name in members)))
            if grown := rise(values, counts):
                found.append(f"{what}: {FIGURES[place]} grow by {grown:.1f} an hour")
    return found


def wrong_in(records: Sequence[Record]) -> list[str]:
    """Return what was not as it has to be."""
    return [*(f"mission {r['mission']}: {r['safety']}: {'; '.join(r['reasons'])}"
              for r in records if r["kind"] == "mission" and r["safety"] != "safe"),
            *(f"mission {r['mission']}, {r['at_s']:g} s: {r['name']} not back after {r['way']}"
              for r in records if r["kind"] == "hit" and r["back_s"] is None),
            *growths(records)]


def soak(_root: Path, options: argparse.Namespace) -> list[str]:
    """Go on with missions until they have lasted as long as asked; return what was wrong."""
    log, is_safe = Log(options.file, options.seed), True
    while is_safe and lasted_s(log) < 3600 * options.hours - 1:
        directory = options.file.with_suffix("") / f"mission-{len(log.of('begin'))}"
        is_safe = one_mission(directory.resolve(), log, options)
    missions, hits = log.of("mission"), log.of("hit")
    say(f"{lasted_s(log) / 3600:.2f} hours, {len(missions)} missions: "
        f"{sum(m['safety'] == 'safe' for m in missions)} safe, "
        f"{sum(m['verdict'] == 'success' for m in missions)} successful, "
        f"{sum(m['cut'] for m in missions)} cut, {sum(m['resets'] for m in missions)} resets of "
        "the emergency stop")
    say(f"process hit until it is replaced: {spread(h['back_s'] for h in hits)}")
    return wrong_in(log.records)


def main() -> int:
    """Run what was asked for and return the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("ways", "pairs", "soak"))
    parser.add_argument("--seed", type=int, default=1, help="of the plan (default: 1)")
    parser.add_argument("--rate", type=float, default=1.0, help="simulated seconds per second")
    parser.add_argument("--file", type=Path, help="JSON lines of pairs and soak")
    parser.add_argument("--hours", type=float, default=1.0, metavar="H",
                        help="how long the soak in the file is to last in all (default: 1)")
    parser.add_argument("--laps", type=int, default=8, metavar="N",
                        help="rounds of a soak's mission after the lights, some three minutes each "
                        "(default: 8)")
    options = parser.parse_args()
    options.file = options.file or Path(f"reports/{options.what}.jsonl")
    with tempfile.TemporaryDirectory() as directory:
        wrong = {"ways": ways, "pairs": pairs, "soak": soak}[options.what](Path(directory), options)
    for line in wrong:
        say(f"WRONG {line}")
    say("all as it has to be" if not wrong else f"{len(wrong)} things are wrong")
    return int(bool(wrong))


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # a mission of the soak ends with it
    sys.exit(main())
