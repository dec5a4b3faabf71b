"""Chaos on real processes: `make chaos`, `make chaos-pairs` and `make soak`; some of it in tests.

    python -m tests.whole.chaos ways|pairs|soak [--seed N] [--file FILE] [--hours H]

ways     every process in every way
pairs    every pair of processes at once; those with the supervisor or the root in all combinations
soak     missions without end, a random fault every five seconds

A plan is pure and seeded: which processes are hit, how, and when. `Chaos` carries it out during a
mission. After each strike it waits until every victim is gone and another process has taken its
place; in pairs the whole system has to be back, too: the supervisor's table has all nodes running
in the processes that /proc shows, with a heartbeat since the repair. An emergency stop that latches
is reset. Two processes are only stopped for a moment (`PAUSE`):

* The root, whose end is the run's. `test_supervision.py` checks that nothing is left behind then.
* The world. It stands for the real one, ground truth included, and is not restarted.

A process of the pool is no node: any other one of the pool counts as its replacement.

One line is printed for each strike or mission, and a summary. Exit code 1 if anything was not as it
has to be: that ends a session. What is done is kept as lines of JSON, and the same command
continues after an interruption; strikes of a mission without a verdict are made again. Other load
on the machine is part of what is tested, so keep it moderate.

In the soak each process is killed once at first: a process of the pool that has replaced another
has more memory of its own than those that were forked at the start, and after that step it counts
whether memory grows. Then half of the faults hit a process, from outside. The other half are those
of messages, sensors, actuators and the world that the run's injector knows; each is over when the
next one comes. A mission of the soak that fails and is safe is counted.

A figure grows if the line through it rises by more per hour than what counts, and what it rises by
is more than chance (a correlation above `CLEAR`). Samples of one mission have a level of their own,
so each is compared with the mean of its mission. The first five minutes of a mission are left out:
processes begin as copies of the root, and what they share with it becomes their own as they touch
it.
"""

import argparse
import contextlib
import json
import os
import random
import re
import shutil
import signal
import statistics
import subprocess
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from rampart.actors.bus.run_folder import ROUTERS
from rampart.actors.osmosis.airport.formats import load_airport
from rampart.actors.osmosis.control.following.route_control import CONTROL_STATE
from rampart.actors.osmosis.control.mission.mission_state import MISSION_STATE
from rampart.actors.runtime.checkpoint_file import read
from rampart.actors.runtime.clock import Clock
from rampart.actors.runtime.run_plan import SUPERVISOR
from rampart.actors.supervision.kill_node import SIGNALS
from rampart.actors.supervision.process_title import find_processes, process_state
from rampart.actors.supervision.root import POOL
from rampart.manager.spec.schema import Kind, SystemSpec
from rampart.manager.spec.specification import parse_specification
from rampart.sim.campaign.plan import fault_groups
from rampart.sim.faults.scenario import PlannedFault
from rampart.testing import RealRun, free_base_port
from tests import ROOT
from tests.real_tools import printed

SYSTEM = ROOT / "systems" / "osmosis.toml"
ROOT_PROCESS = "root"
WAYS = ("KILL", "STOP", "SEGV", "WEDGE")
PAUSE = "PAUSE"
BACK_WITHIN_S = 10.0
"""Wall seconds for each victim of a strike, on a machine that may be busy."""

WORLD_PAUSE_S = 0.4
"""Simulated seconds: the Safety Pilot misses the laser and stops. After a second an emergency stop
would follow, the right answer to a robot without senses."""

ROOT_PAUSE_S = 1.0
"""Wall seconds."""

GAP_S = 0.4
"""The second of a pair is hit at once, or up to so many wall seconds later."""

BREATH_S = 0.3
"""Wall seconds between everything being back and the next strike."""

FIRST_S, EVERY_S, LASTS_S = 10.0, 5.0, (0.5, 4.0)
"""Simulated seconds before a mission's first fault, between two, and of one of the injector."""

LONGEST_S = 3600.0
"""Simulated seconds of a mission for which faults are planned."""

MISSION_S, END_WITHIN_S = 1200.0, 60.0
SAMPLE_S = 10.0
WARM_UP_S = 300.0
FIGURES = ("MB", "descriptors", "threads")
COUNTS = {"all": (30.0, 60.0, 20.0), ROOT_PROCESS: (15.0, 6.0, 2.0)}
ONE = (5.0, 6.0, 2.0)
"""How much in an hour counts: of all together, of the root, and of any other process."""

CLEAR = 0.5
EMERGENCY_STOP = "RM1"

_ENDED = re.compile(r"\] mission \S+ (succeeded|failed|cancelled)")
_DECISION = re.compile(r"\] decision \d+: (.*)")

Record = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Hit:
    """A process and how it is hit."""

    name: str
    way: str


@dataclass(frozen=True, slots=True)
class Strike:
    """Processes that are hit, `gap_s` wall seconds apart, not before a simulated second."""

    hits: tuple[Hit, ...]
    at_s: float = 0.0
    gap_s: float = 0.0

    @property
    def names(self) -> tuple[str, ...]:
        """Victims."""
        return tuple(hit.name for hit in self.hits)

    def __str__(self) -> str:
        victims = "  ".join(f"{hit.way:<5} {hit.name:<16}" for hit in self.hits)
        return victims + (f" {self.gap_s * 1e3:3.0f} ms apart" if len(self.hits) > 1 else "")


@dataclass(frozen=True, slots=True)
class Targets:
    """Processes that can be hit in every way, and those that are only paused."""

    mortal: tuple[str, ...]
    paused: tuple[str, ...]

    def hit(self, dice: random.Random, name: str, ways: Sequence[str] = WAYS) -> Hit:
        """Return a hit of a process in a way that is drawn."""
        return Hit(name, PAUSE if name in self.paused else dice.choice(ways))


def load() -> SystemSpec:
    """Return the full system."""
    return parse_specification(SYSTEM.read_text(encoding="utf-8"), SYSTEM.name)


def targets(spec: SystemSpec) -> Targets:
    """Return the processes of a system, one name for each, and those that every system has."""
    nodes = [members[0] for members in spec.processes().values()]
    mortal = tuple(node.name for node in nodes if node.kind is not Kind.WORLD)
    world = tuple(node.name for node in nodes if node.kind is Kind.WORLD)
    return Targets((*mortal, SUPERVISOR, *ROUTERS, POOL), (*world, ROOT_PROCESS))


def each_in_every_way(of: Targets, seed: int, every_s: float = 4.0) -> list[Strike]:
    """Return four rounds in which every process is hit, each time in another way.

    No process is hit twice in succession.
    """
    dice = random.Random(f"chaos {seed}")
    ways = {name: dice.sample(WAYS, len(WAYS)) for name in of.mortal}
    strikes: list[Strike] = []
    for i in range(len(WAYS)):
        names = dice.sample([*of.mortal, *of.paused], len(of.mortal) + len(of.paused))
        if strikes and (names[0],) == strikes[-1].names:
            names.reverse()
        strikes += [Strike((of.hit(dice, name, ways.get(name, WAYS)[i:i + 1]),),
                           every_s * (len(strikes) + place)) for place, name in enumerate(names)]
    return strikes


def every_pair(of: Targets, seed: int) -> list[Strike]:
    """Return every pair of a system's processes in a drawn order, each killed, stopped or hung.

    A pair with the supervisor or the root comes in all combinations of ways, and others in one.
    """
    dice = random.Random(f"pairs {seed}")
    names = [name for name in of.mortal if name != POOL]  # one may replace the other
    lasting = tuple(way for way in WAYS if way != "SEGV")
    drawn = []
    for pair in combinations((*names, *of.paused), 2):
        each = [[(way,) for way in lasting] if name in names else [(PAUSE,)] for name in pair]
        combined = list(product(*each))
        if not {SUPERVISOR, ROOT_PROCESS} & set(pair):
            combined = [dice.choice(combined)]
        for ways in combined:
            hits = [of.hit(dice, name, way) for name, way in zip(pair, ways, strict=True)]
            dice.shuffle(hits)
            gap_s = 0.0 if dice.random() < 0.4 else dice.uniform(0.0, GAP_S)
            drawn.append(Strike(tuple(hits), gap_s=gap_s))
    dice.shuffle(drawn)
    return drawn


def of_a_soak(spec: SystemSpec, seed: int, mission: int) -> tuple[list[Strike], list[PlannedFault]]:
    """Return what hits the processes of a mission, and the faults of the injector."""
    dice = random.Random(f"soak {seed} {mission}")
    of = targets(spec)
    groups = {kind: names for kind, names in fault_groups(spec).items()
              if kind != "process" and names}
    strikes, faults = [], []
    first = dice.sample(of.mortal, len(of.mortal))
    for i in range(int((LONGEST_S - FIRST_S) / EVERY_S)):
        at_s = FIRST_S + i * EVERY_S
        if i < len(first):
            strikes.append(Strike((Hit(first[i], "KILL"),), at_s))
        elif dice.random() < 0.5:
            strikes.append(Strike((of.hit(dice, dice.choice((*of.mortal, *of.paused))),), at_s))
        else:
            names = groups[dice.choice(list(groups))]
            faults.append(PlannedFault(dice.choice(names), at_s,
                                       duration_s=round(dice.uniform(*LASTS_S), 2)))
    return strikes, faults


@dataclass(frozen=True, slots=True)
class Struck:
    """A strike that was carried out.

    Attributes:
        strike: The strike.
        back_s: Wall seconds from the first signal until all was back that was asked for; None if
            it was not in time.
        missing: What was not back.
    """

    strike: Strike
    back_s: float | None
    missing: str = ""

    def __str__(self) -> str:
        back = f"NOT BACK: {self.missing}" if self.back_s is None else (
            f"back in {self.back_s * 1e3:5.0f} ms")
        return f"{self.strike}  {back}"


class Chaos:
    """Carries out strikes on a run whose mission is under way.

    Args:
        run: The run.
        report: Is called with each strike that was carried out.
        everything: Whether the whole system has to be back, and not only the victims.
        until_s: When to stop, on the monotonic clock.

    Attributes:
        struck: What was carried out.
        resets: Emergency stops that were released.
        now_s: Simulated seconds.
    """

    def __init__(self, run: RealRun, report: Callable[[Struck], object] = lambda _: None, *,
                 everything: bool = False, until_s: float = float("inf")) -> None:
        self.struck: list[Struck] = []
        self.resets = 0
        self._run, self._report = run, report
        self._everything, self._until_s = everything, until_s
        self._rate = run.info.rate
        self.now_s = Clock(run.info.origin_s, self._rate).now
        self._read = 0
        self._is_over = False
        self._decided = ""

    def carry_out(self, strikes: Iterable[Strike],
                  meanwhile: Callable[[], object] = lambda: None) -> list[Strike]:
        """Strike while the mission lasts; return what was left to be done."""
        strikes = list(strikes)
        for i, strike in enumerate(strikes):
            while self.now_s() < strike.at_s and not self.over():
                meanwhile()
                time.sleep(0.02)
            self._release()
            if self.over() or not self._strike(strike):
                return strikes[i:]
            time.sleep(BREATH_S)
        return []

    def over(self) -> bool:
        """Return whether the mission has ended, or the run, or the time for it; or is unsafe."""
        new = self._run.story_from(self._read)
        whole = new[:new.rfind("\n") + 1]
        self._read += len(whole.encode())
        for decision in _DECISION.finditer(whole):
            self._decided = decision[1]
        self._is_over = (self._is_over or _ENDED.search(whole) is not None or "UNSAFE" in whole
                         or self._run.process.poll() is not None
                         or time.monotonic() >= self._until_s)
        return self._is_over

    def _strike(self, strike: Strike) -> bool:
        """Hit, and wait for the repair; return whether the run lasted so long."""
        begun_s = time.monotonic()
        deadline = begun_s + BACK_WITHIN_S * len(strike.hits)
        before: dict[str, int] = {}
        missing = "a victim"
        while missing and time.monotonic() < deadline:
            if self.over():
                return False
            if before:
                missing = ", ".join(hit.name for hit in strike.hits
                                    if not self._is_replaced(hit, before[hit.name]))
                missing = missing or (self._missing() if self._everything else "")
            elif set(strike.names) <= (there := self._pids()).keys():
                before, begun_s = there, time.monotonic()
                self._send(strike, before)
            time.sleep(0.005)
        back_s = None if missing else time.monotonic() - begun_s
        self.struck.append(Struck(strike, back_s, missing))
        self._report(self.struck[-1])
        return True

    def _release(self) -> None:
        """Reset the emergency stop, as an operator does, when nothing else keeps the robot."""
        latched = f"({EMERGENCY_STOP})" in self._decided and " for " not in self._decided
        if latched and not self.over():
            self.resets += self._run.tool("reset", EMERGENCY_STOP).returncode == 0

    def _send(self, strike: Strike, pids: dict[str, int]) -> None:
        """Send each signal when it is due, those included that let the paused go on."""
        due: list[tuple[float, str, int]] = []
        for i, hit in enumerate(strike.hits):
            at_s = i * strike.gap_s
            due.append((at_s, hit.name, SIGNALS["STOP" if hit.way == PAUSE else hit.way]))
            if hit.way == PAUSE:
                pause_s = ROOT_PAUSE_S if hit.name == ROOT_PROCESS else WORLD_PAUSE_S / self._rate
                due.append((at_s + pause_s, hit.name, signal.SIGCONT))
        begun_s = time.monotonic()
        for at_s, name, number in sorted(due):
            time.sleep(max(0.0, begun_s + at_s - time.monotonic()))
            with contextlib.suppress(ProcessLookupError):
                os.kill(pids[name], number)

    def _pids(self) -> dict[str, int]:
        pids = {ROOT_PROCESS: self._run.process.pid}
        for process in sorted(find_processes(self._run.port), key=lambda p: p.incarnation):
            pids |= dict.fromkeys(process.names, process.pid)
        return pids

    def _is_replaced(self, hit: Hit, old: int) -> bool:
        new = self._pids().get(hit.name)
        if hit.way == PAUSE:
            return new == old and process_state(old) in "SRD"
        return new not in {None, old} and process_state(old) in "XZ"

    def _missing(self) -> str:
        """Return what is not as it has to be, "" if all nodes run and sent a heartbeat just now.

        The supervisor, which does not hear itself, shows by its table that it works.
        """
        since_s = self.now_s() - 1.0
        table = json.loads(printed(self._run, "node", "list", "--json") or "[]")
        there, wrong = self._pids(), []
        for row in table:
            is_late = row["name"] != SUPERVISOR and row.get("heard_s", 0.0) < since_s
            if is_late or row["state"] != "running" or row["pid"] != there.get(row["name"]):
                wrong.append(f"{row['name']} {row['state']}, {row['pid']}")
        return ", ".join(wrong) if table else "no table from the supervisor"


def complaints(code: int, result: Mapping[str, Any], story: str, lights: tuple[str, ...] = ("",),
               ) -> list[str]:
    """Return what is wrong with a run that has ended; empty if all is as it has to be.

    Three records of lights are compared: the result, and both nodes' checkpoints. A light that was
    measured twice has two intensities, and one of the three has the other one.

    Args:
        code: Its exit code.
        result: What it printed with --json.
        story: And on stderr.
        lights: How the names of the lights begin that the mission passes.
    """
    if (code, result.get("mission"), result.get("safety")) != (0, "success", "safe"):
        return [f"exit code {code}, {result}"]  # and lights are missing
    wrong = [f"printed: {line}" for line in story.splitlines()
             if "UNSAFE" in line or "given up" in line]
    report = Path(result["report"])
    run_id = report.stem.removeprefix("inspection-")
    reported = {one["name"]: one["intensity_cd"] for one in result["lights"]
                if one["verdict"] != "not measured"}
    expected = {one["name"] for one in result["lights"] if one["name"].startswith(lights)}
    if reported.keys() != expected:
        wrong.append(f"lights: {sorted(reported)}, not {sorted(expected)}")
    for node, form in (("mission_manager", MISSION_STATE), ("osmosis_control", CONTROL_STATE)):
        newest = read(report.parent / "checkpoints", node, run_id).records[0]
        state: Any = form.decode(newest.version, newest.state)
        kept = state.lights if node == "mission_manager" else state.lights.measured
        if sorted((x.light, x.intensity_cd) for x in kept) != sorted(reported.items()):
            wrong.append(f"lights of {node}: {kept}, not {reported}")
    return wrong


def usage(run: RealRun) -> dict[str, tuple[float, ...]]:
    """Return each process's `FIGURES`; the memory is what it has of its own."""
    pids = {p.names[0]: p.pid for p in find_processes(run.port)} | {ROOT_PROCESS: run.process.pid}
    used = {}
    for name, pid in pids.items():
        with contextlib.suppress(psutil.Error):  # it has just ended
            process = psutil.Process(pid)
            used[name] = (process.memory_full_info().uss / 1e6, process.num_fds(),
                          process.num_threads())
    return used


def growths(records: Sequence[Record]) -> list[str]:
    """Return which figures grow: of all processes together, of the root, and of the others.

    The two routers count as one: all clients are of one of them, and change over when it is killed.
    """
    samples = [r for r in records if r["kind"] == "sample" and r["into_s"] >= WARM_UP_S]
    names = sorted({name for r in samples for name in r["used"]} - set(ROUTERS))
    members = {"all": (*names, *ROUTERS), "routers": ROUTERS, **{name: (name,) for name in names}}
    found = []
    for what, place in product(members, range(len(FIGURES))):
        missions: dict[int, list[tuple[float, float]]] = defaultdict(list)
        for r in samples:
            there = [r["used"][name][place] for name in members[what] if name in r["used"]]
            if len(there) == len(members[what]):
                missions[r["mission"]].append((r["into_s"] / 3600, sum(there)))
        around = [np.array(points) - np.mean(points, axis=0) for points in missions.values()]
        hours, values = np.concatenate(around).T if around else np.zeros((2, 1))
        if not hours.any() or not values.any():
            continue
        an_hour = np.polyfit(hours, values, 1)[0]
        is_clear = np.corrcoef(hours, values)[0, 1] > CLEAR
        if is_clear and an_hour > COUNTS.get(what, ONE)[place]:
            found.append(f"{what}: {FIGURES[place]} grow by {an_hour:.1f} an hour")
    return found


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

    @property
    def lasted_s(self) -> float:
        """Wall seconds of all missions, those that were cut included."""
        return self.records[-1]["at_s"] if self.records else 0.0

    def wrong(self) -> list[str]:
        """Return what was not as it has to be."""
        return [*(f"mission {r['mission']}: {line}" for r in self.of("mission")
                  for line in r["wrong"]),
                *(f"mission {r['mission']}, {r['at_s']:g} s: not back after {r['strike']}: "
                  f"{r['missing']}" for r in self.of("hit") if r["back_s"] is None),
                *growths(self.records)]

    def _append(self, text: str) -> None:
        self._file.parent.mkdir(parents=True, exist_ok=True)
        with self._file.open("a", encoding="utf-8") as out:
            out.write(text)


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


def one_mission(log: Log, options: argparse.Namespace, strikes: Sequence[Strike],
                faults: Sequence[PlannedFault]) -> bool:
    """Hit the processes of a mission; return whether it was as it has to be.

    Its directory is kept if not.
    """
    number, is_soak = len(log.of("begin")), options.what == "soak"
    zero_s = time.monotonic() - log.lasted_s
    until_s = zero_s + 3600 * options.hours if is_soak else float("inf")
    directory = (options.file.with_suffix("") / f"mission-{number}").resolve()

    def keep(kind: str, **fields: object) -> None:
        log.add(kind, at_s=round(time.monotonic() - zero_s, 3), mission=number, **fields)

    def hit(struck: Struck) -> None:
        keep("hit", strike=str(struck.strike), back_s=struck.back_s, missing=struck.missing)
        say(struck)

    def sample() -> None:
        nonlocal sampled_s
        if is_soak and time.monotonic() - sampled_s >= SAMPLE_S:
            sampled_s = time.monotonic()
            keep("sample", into_s=round(chaos.now_s(), 2), used=usage(run))

    keep("begin")
    directory.mkdir(parents=True, exist_ok=True)
    with RealRun(directory, SYSTEM, "--mission", str(write_laps(directory, options.laps)),
                 "--hmi-port", str(free_base_port()), "--patience",
                 "90", "--seed", str(options.seed + number),
                 *(word for fault in faults for word in ("--fault", fault.text())),
                 hmi=True) as run:
        run.wait_for("goal 1/", END_WITHIN_S)
        chaos = Chaos(run, hit, everything=options.what == "pairs", until_s=until_s)
        sampled_s = time.monotonic()
        chaos.carry_out(strikes, sample)
        was_cut = time.monotonic() >= until_s or "UNSAFE" in run.story
        if was_cut:
            run.process.send_signal(signal.SIGTERM)
        try:
            code, result = run.result(END_WITHIN_S if was_cut else MISSION_S)
        except (AssertionError, subprocess.TimeoutExpired) as error:
            code, result = -1, {"mission": "fail", "safety": "not known", "reasons": [repr(error)]}
    verdict = f"{'cut' if was_cut else result['mission']}, {result['safety']}"
    if is_soak:
        wrong = [] if result["safety"] == "safe" else result["reasons"]
    else:
        wrong = complaints(code, result, run.story, ("A", "B"))
    if options.what == "ways" and chaos.resets:
        wrong.append(f"{chaos.resets} emergency stops")
    keep("mission", verdict=verdict, wrong=wrong, resets=chaos.resets)
    say(f"mission {number}: {verdict}, {chaos.resets} resets; {log.lasted_s / 60:.1f} min")
    if not wrong:
        shutil.rmtree(directory)
    return not wrong


def session(log: Log, options: argparse.Namespace) -> None:
    """Go on with missions until everything was hit, or they have lasted as long as asked."""
    is_well, spec = True, load()
    while is_well:
        faults: list[PlannedFault] = []
        if options.what == "soak":
            strikes, faults = of_a_soak(spec, options.seed, len(log.of("begin")))
            if log.lasted_s >= 3600 * options.hours - 1:
                return
        else:
            plan = {"ways": each_in_every_way, "pairs": every_pair}[options.what]
            ended = {mission["mission"] for mission in log.of("mission")}
            done = sum(hit["mission"] in ended for hit in log.of("hit"))
            strikes = plan(targets(spec), options.seed)[done:]
            if not strikes:
                return
            strikes = [replace(one, at_s=one.at_s - strikes[0].at_s) for one in strikes]
        is_well = one_mission(log, options, strikes, faults)


def main() -> int:
    """Run what was asked for and return the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("ways", "pairs", "soak"))
    parser.add_argument("--seed", type=int, default=1, help="of the plan (default: 1)")
    parser.add_argument("--file", type=Path, help="JSON lines of what was done")
    parser.add_argument("--hours", type=float, default=1.0, metavar="H",
                        help="how long the soak in the file is to last in all (default: 1)")
    parser.add_argument("--laps", type=int, metavar="N", help="rounds of a mission after the "
                        "lights, some three minutes each (default: 8 of a soak, else 4)")
    options = parser.parse_args()
    options.file = options.file or Path(f"reports/{options.what}.jsonl")
    if options.laps is None:
        options.laps = 8 if options.what == "soak" else 4
    log = Log(options.file, options.seed)
    session(log, options)
    missions, hits = log.of("mission"), log.of("hit")
    say(f"{log.lasted_s / 3600:.2f} hours, {sum(m['resets'] for m in missions)} resets of the "
        f"emergency stop, {len(missions)} missions: "
        + ", ".join(f"{count} {verdict}" for verdict, count in Counter(
            m["verdict"] for m in missions).items()))
    back_s = [hit["back_s"] for hit in hits if hit["back_s"] is not None] or [0.0]
    say(f"{len(hits)} strikes, all back after {statistics.median(back_s):.2f} s (median), at most "
        f"{max(back_s):.2f} s")
    wrong = log.wrong()
    for line in wrong:
        say(f"WRONG {line}")
    say("all as it has to be" if not wrong else f"{len(wrong)} things are wrong")
    return int(bool(wrong))


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # a mission of the soak ends with it
    sys.exit(main())
