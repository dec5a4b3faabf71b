"""The soak, `make soak HOURS=n`: missions without end, a random fault every five seconds.

    python -m tests.whole.soak_runs --hours H [--seed N] [--laps L] [--rate R] [--file FILE]

Missions of the full system follow one another. First each process is killed once: a process of the
pool that has replaced another has more memory of its own than those that were forked at the start,
and after that step it counts whether memory grows. Then half of the faults hit a process, from
outside. The other half are those of messages, sensors, actuators and the world that the run's
injector knows; each is over when the next one comes. An emergency stop that latches is reset.

Faults, missions and their verdicts, and every ten seconds what each process uses are kept as lines
of JSON: an interrupted soak continues with the same command until it has lasted HOURS. At the end
figures are printed. A mission that fails and is safe is counted. One that is not safe ends the
soak; its report is kept. Exit code 1 if anything was unsafe, not brought back, or grows.

A figure grows if the line through it rises by more per hour than what counts, and what it rises by
is more than chance (a correlation above `CLEAR`). Samples of one mission have a level of their own,
so each is compared with the mean of its mission. The first five minutes of a mission are left out:
processes begin as copies of the root, and what they share with it becomes their own as they touch
it.
"""

from __future__ import annotations

import argparse
import random
import shutil
import signal
import statistics
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path

import psutil

from rampart.actors.bus.run_folder import ROUTERS
from rampart.actors.supervision.process_title import find_processes
from rampart.manager.spec.schema import SystemSpec
from rampart.sim.campaign.plan import fault_groups
from rampart.sim.faults.scenario import PlannedFault
from rampart.testing import RealRun
from tests.whole.chaos import ROOT_PROCESS, Chaos, Hit, Strike, Struck, targets
from tests.whole.chaos_runs import Log, Record, load, say, spread, start, write_laps

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


def wrong(records: Sequence[Record]) -> list[str]:
    """Return what was not as it has to be."""
    return [*(f"mission {r['mission']}: {r['safety']}: {'; '.join(r['reasons'])}"
              for r in records if r["kind"] == "mission" and r["safety"] != "safe"),
            *(f"mission {r['mission']}, {r['at_s']:g} s: {r['name']} not back after {r['way']}"
              for r in records if r["kind"] == "hit" and r["back_s"] is None),
            *growths(records)]


def main() -> int:
    """Run what was asked for and return the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hours", type=float, default=1.0, metavar="H",
                        help="how long the soak in the file is to last in all (default: 1)")
    parser.add_argument("--seed", type=int, default=1, help="of the faults (default: 1)")
    parser.add_argument("--rate", type=float, default=1.0, help="simulated seconds per second")
    parser.add_argument("--laps", type=int, default=8, metavar="N",
                        help="rounds of a mission after the lights, some three minutes each "
                        "(default: 8)")
    parser.add_argument("--file", type=Path, default=Path("reports/soak.jsonl"),
                        help="JSON lines of all that was done (default: %(default)s)")
    options = parser.parse_args()
    log = Log(options.file, options.seed)
    is_safe = True
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
    found = wrong(log.records)
    for line in found:
        say(f"WRONG {line}")
    return int(bool(found))


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # its mission ends with it
    sys.exit(main())
