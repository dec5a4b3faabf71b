"""The soak, `make soak HOURS=n`: missions without end, a random fault every five seconds.

    python -m tests.whole.soak_runs --hours H [--seed N] [--laps L] [--rate R] [--file FILE]

Missions of the full system follow one another. First each process is killed once: a process of the
pool that has replaced another has more memory of its own than those that were forked at the start,
and after that step it counts whether memory grows. Then half of the faults hit a process, from
outside. The other half are those of messages, sensors, actuators and the world that the run's
injector knows; each is over when the next one comes. An emergency stop that latches is reset.

Faults and how soon each was detected and over, missions and their verdicts, and every ten seconds
what each process uses are kept as lines of JSON: an interrupted soak continues with the same
command until it has lasted HOURS. At the end, and with --summary alone, figures are printed. A
mission that fails and is safe is counted. One that is not safe ends the soak; its report is kept.
Exit code 1 if anything was unsafe, not brought back, or grows.
"""

from __future__ import annotations

import argparse
import json
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil

from rampart.actors.supervision.process_title import find_processes
from rampart.manager.spec.schema import SystemSpec
from rampart.sim.campaign.plan import fault_groups
from rampart.sim.faults.scenario import PlannedFault
from rampart.testing import RealRun
from tests.whole.chaos import ROOT_PROCESS, Chaos, Hit, Strike, Struck, targets
from tests.whole.chaos_runs import Log, load, say, start, write_laps
from tests.whole.soak_summary import summary, wrong

EVERY_S, FIRST_S = 5.0, 10.0
"""Simulated seconds between two faults of a mission, and before the first one."""

LASTS_S = (0.5, 4.0)
SAMPLE_S = 10.0
END_WITHIN_S = 60.0
LONGEST_S = 3600.0
"""Simulated seconds of a mission for which faults are planned."""


@dataclass(frozen=True, slots=True)
class Plan:
    """Faults of one mission: hits of processes by simulated second, and faults of its injector."""

    hits: tuple[tuple[float, Hit], ...]
    faults: tuple[PlannedFault, ...]


def plan(spec: SystemSpec, seed: int, mission: int) -> Plan:
    """Return the faults of a mission, counted from 0."""
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
    return Plan(tuple(hits), tuple(faults))


def lasted_s(log: Log) -> float:
    """Return the wall seconds that a soak has lasted, missions that were cut included."""
    return max((r["at_s"] for r in log.records if "at_s" in r), default=0.0)


class Mission:
    """One mission of a soak: hits its processes and samples what they use."""

    def __init__(self, run: RealRun, log: Log, number: int, planned: Plan) -> None:
        self._run = run
        self._log = log
        self._number = number
        self._due = list(planned.hits)
        self._zero_s = time.monotonic() - lasted_s(log)
        self.chaos = Chaos(run, self._hit)
        self._info = run.info
        self._hit_s = 0.0

    def through(self, until_s: float) -> bool:
        """Hit and sample until it is over; return whether the soak's time was up first."""
        sampled_s = 0.0
        while not self.chaos.over():
            if self._due and self._into_s() >= self._due[0][0]:
                self.chaos.release()
                self._hit_s = self._into_s()
                self.chaos.strike(Strike((self._due.pop(0)[1],)))
            if self._into_s() > EVERY_S and time.monotonic() - sampled_s >= SAMPLE_S:
                sampled_s = time.monotonic()
                self._log.add("sample", at_s=self.at_s(), mission=self._number,
                              into_s=round(self._into_s() / self._info.rate, 2),
                              used=self._usage())
            if self.at_s() >= until_s or self.chaos.is_unsafe:
                return True
            time.sleep(0.1)
        return False

    def at_s(self) -> float:
        """Wall seconds of the soak."""
        return round(time.monotonic() - self._zero_s, 3)

    def _into_s(self) -> float:
        return (time.monotonic() - self._info.origin_s) * self._info.rate

    def _hit(self, struck: Struck) -> None:
        hit, = struck.strike.hits
        self._log.add("hit", at_s=self.at_s(), mission=self._number, into_s=round(self._hit_s, 3),
                      name=hit.name, way=hit.way, back_s=struck.back_s)

    def _usage(self) -> dict[str, tuple[int, int, int, int]]:
        """Return each process's own memory and its share (kB), descriptors and threads."""
        used = {}
        for name, pid in {ROOT_PROCESS: self._run.process.pid, **{
                p.names[0]: p.pid for p in find_processes(self._run.port)}}.items():
            try:
                process = psutil.Process(pid)
                memory = process.memory_full_info()
                used[name] = (memory.uss // 1024, memory.pss // 1024, process.num_fds(),
                              process.num_threads())
            except psutil.Error:
                continue  # it has just ended
        return used


def one_mission(directory: Path, log: Log, options: argparse.Namespace) -> bool:
    """Carry out a mission; return whether it was safe. Its directory is kept if not."""
    number = len(log.of("begin"))
    planned = plan(load(), options.seed, number)
    faults = [word for fault in planned.faults for word in ("--fault", fault.text())]
    log.add("begin", at_s=lasted_s(log), mission=number)
    laps = write_laps(directory.parent, options.laps)
    with start(directory, laps, options.rate, "--seed", str(options.seed + number), *faults) as run:
        mission = Mission(run, log, number, planned)
        was_cut = mission.through(3600 * options.hours)
        if was_cut:
            run.process.send_signal(signal.SIGTERM)
        try:
            code, result = run.result(END_WITHIN_S)
        except (AssertionError, subprocess.TimeoutExpired) as error:
            code, result = -1, {"mission": "fail", "safety": "not known", "duration_s": 0.0,
                                "reasons": [f"no verdict: {type(error).__name__}"]}
        ended_s = mission.at_s()
    _keep_latencies(log, number, result, planned)
    is_safe = bool(result["safety"] == "safe")
    kept = Path(options.file).with_suffix("") / f"mission-{number}"
    if not is_safe:
        shutil.copytree(directory, kept, dirs_exist_ok=True)
    log.add("mission", at_s=ended_s, mission=number, verdict=result["mission"], cut=was_cut,
            safety=result["safety"], code=code, reasons=result["reasons"],
            duration_s=result["duration_s"], resets=mission.chaos.resets,
            left=[str(process) for process in find_processes(run.port)],
            kept="" if is_safe else str(kept))
    say(f"mission {number}: {'cut' if was_cut else result['mission']}, {result['safety']}, "
        f"{result['duration_s']:.0f} s, {mission.chaos.resets} resets; {ended_s / 60:.1f} min of "
        "soak")
    return is_safe


def _keep_latencies(log: Log, number: int, result: dict[str, Any], planned: Plan) -> None:
    """Keep how soon each fault was detected and over, from the record of the mission."""
    try:
        record = json.loads(Path(result["record"]).read_text(encoding="utf-8"))
    except (KeyError, OSError, TypeError, ValueError):
        return

    def keep(fault: str, at_s: float, found: Sequence[dict[str, Any]], **more: Any) -> None:
        log.add("latency", mission=number, into_s=at_s, fault=fault, **more,
                detected_s=found[0]["from_s"] - at_s if found else None,
                over_s=max(b["to_s"] for b in found) - at_s if found else None)

    bars = record["intervals"]
    for hit in (hit for hit in log.of("hit") if hit["mission"] == number):
        at_s = hit["into_s"]
        found = [b for b in bars if b["lane"] == "down" and b["name"] == hit["name"]
                 and at_s <= b["from_s"] <= at_s + EVERY_S]
        if found:
            keep(f"{hit['way']} {hit['name']}", at_s, found[:1])
    for fault, outcome in zip(planned.faults, record["faults"], strict=False):
        if (at_s := outcome["injected_s"]) is not None:
            ends_s = at_s + (fault.duration_s or 0.0) + 1.0
            keep(fault.fault, at_s, [b for b in bars if b["lane"] == "detection"
                                     and at_s <= b["from_s"] <= ends_s],
                 affected=outcome["affected"])


def main(arguments: list[str] | None = None) -> int:
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
    parser.add_argument("--summary", action="store_true", help="only print what is in the file")
    options = parser.parse_args(arguments)
    if not 0 < options.hours < 1000:
        parser.error(f"--hours {options.hours:g}: must be above 0 and below 1000")
    log = Log(options.file, options.seed)
    if not options.summary:
        with tempfile.TemporaryDirectory() as folder:
            while lasted_s(log) < 3600 * options.hours - 1:
                if not one_mission(Path(folder) / f"run{len(log.of('begin'))}", log, options):
                    break
    for line in summary(log.records):
        say(line)
    return int(bool(wrong(log.records)))


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # its mission ends with it
    sys.exit(main())
