"""The soak, `make soak HOURS=n`: missions without end, a random fault every five seconds.

`python -m tests.whole.soak_runs --hours H [--seed N] [--laps L] [--rate R] [--file FILE]`. Missions
of the full system, one after the other; what goes wrong in them follows from the seed, but first
each process is killed once (`soak_plan`). An emergency stop that latches is reset as an operator
would. Everything is kept as lines of JSON: each fault, how soon it was detected and over, each
mission's verdict, and every ten seconds what each process uses: memory of its own (USS) and its
share (PSS), descriptors, threads. What is in the file counts: an interrupted soak goes on with the
same command until it has lasted HOURS.

At the end, and with --summary alone: figures, what grows, and beside the file a plot (PNG) and a
page (HTML). A mission that fails and is safe is counted; one that is not safe ends the soak, its
report and story are kept. Exit code 1 if anything was unsafe, not brought back, or grows.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from rampart.actors.supervision.kill_node import SIGNALS
from rampart.actors.supervision.process_title import RunProcess, find_processes, process_state
from rampart.testing import RealRun, free_base_port
from tests.whole.chaos import WORLD_PAUSE_S, targets
from tests.whole.chaos_pairs import LAUNCHER, LAUNCHER_PAUSE_S, PAUSE, PairChaos
from tests.whole.chaos_runs import SYSTEM, load, say, write_laps
from tests.whole.soak_page import write_page
from tests.whole.soak_plan import EVERY_S, Blow, Plan, plan
from tests.whole.soak_summary import summary, wrong

SAMPLE_S = 10.0
STARTED_S = 5.0
"""Simulated seconds of a mission before which not everything is there."""

LOOK_S = 0.1
BACK_WITHIN_S = 20.0
END_WITHIN_S = 60.0
LONGEST_S = 3600.0
"""Simulated seconds for which faults are planned: of one mission."""


class Soak:
    """The file of a soak, and how long it has lasted."""

    def __init__(self, file: Path, seed: int) -> None:
        self.records: list[dict[str, Any]] = []
        self._file = file
        self._seed = seed
        for line in file.read_text(encoding="utf-8").splitlines() if file.exists() else ():
            with contextlib.suppress(json.JSONDecodeError):  # cut off when it was interrupted
                self.records.append(json.loads(line))
        if any(record["seed"] != seed for record in self.records):
            raise SystemExit(f"{file}: of another seed than {seed}; choose another --file")
        if file.exists() and not file.read_bytes().endswith(b"\n"):
            self._append("\n")

    def add(self, kind: str, **fields: Any) -> None:
        """Keep a record, on disk too."""
        record = {"kind": kind, "seed": self._seed, **fields}
        self.records.append(record)
        self._append(json.dumps(record) + "\n")

    def of(self, kind: str) -> list[dict[str, Any]]:
        """Return the records of a kind."""
        return [record for record in self.records if record["kind"] == kind]

    @property
    def lasted_s(self) -> float:
        """Wall seconds that it has lasted, missions that were broken off included."""
        return max((r["at_s"] for r in self.records if "at_s" in r), default=0.0)

    @property
    def missions(self) -> int:
        """How many were begun."""
        return len(self.of("begin"))

    def _append(self, text: str) -> None:
        self._file.parent.mkdir(parents=True, exist_ok=True)
        with self._file.open("a", encoding="utf-8") as out:
            out.write(text)


class Mission:
    """One mission of a soak.

    Args:
        run: of it, started.
        soak: where everything is kept.
        number: of the mission, from 0.
        planned: what goes wrong.
        until_s: wall seconds of the soak after which it is broken off.
    """

    def __init__(self, run: RealRun, soak: Soak, number: int, planned: Plan, until_s: float
                 ) -> None:
        self._run = run
        self._soak = soak
        self._number = number
        self._until_s = until_s
        self._zero_s = time.monotonic() - soak.lasted_s
        self._world = targets(load()).world
        self._due = list(planned.blows)
        self._told = 0
        self._open: list[tuple[Blow, int, float, float]] = []
        self._lets_go: list[tuple[float, int]] = []
        self._sampled_s = 0.0
        self._chaos: PairChaos | None = None

    @property
    def _at_s(self) -> float:
        return round(time.monotonic() - self._zero_s, 3)

    def through(self) -> bool:
        """Hit and look until it is over; tell whether its time was up first."""
        info = self._run.info
        chaos = self._chaos = PairChaos(self._run, self._world)
        try:
            while not chaos.over():
                now_s = (time.monotonic() - info.origin_s) * info.rate
                self._let_go()
                if self._due and now_s >= self._due[0].at_s:
                    chaos.release()
                    self._strike(self._due.pop(0))
                self._look_for_those_hit()
                if now_s > STARTED_S and time.monotonic() - self._sampled_s >= SAMPLE_S:
                    self._sample(now_s / info.rate)
                if self._at_s >= self._until_s or self._was_unsafe():
                    return True
                time.sleep(LOOK_S / 5 if self._open else LOOK_S)
        finally:
            self._let_go(at_once=True)
        return False

    def _was_unsafe(self) -> bool:
        new = self._run.story_from(self._told)
        self._told += len(new.rpartition("\n")[0].encode())
        return "UNSAFE" in new

    @property
    def resets(self) -> int:
        """Emergency stops that were released."""
        return self._chaos.resets if self._chaos else 0

    def _processes(self) -> dict[str, RunProcess]:
        found = sorted(find_processes(self._run.port), key=lambda p: p.incarnation)
        return {name: process for process in found for name in process.names}

    def _strike(self, blow: Blow) -> None:
        pid = self._run.process.pid
        if blow.name != LAUNCHER:
            there = self._processes().get(blow.name)
            pid = there.pid if there else 0
        if not pid:
            self._soak.add("blow", at_s=self._at_s, mission=self._number, into_s=blow.at_s,
                           name=blow.name, way=blow.way, pid=0, back_s=None, absent=True)
            return
        info = self._run.info
        into_s = (time.monotonic() - info.origin_s) * info.rate
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGSTOP if blow.way == PAUSE else SIGNALS[blow.way])
        if blow.way == PAUSE:
            for_s = LAUNCHER_PAUSE_S[0] if blow.name == LAUNCHER else WORLD_PAUSE_S
            self._lets_go.append((time.monotonic() + for_s, pid))
        self._open.append((blow, pid, time.monotonic(), round(into_s, 3)))

    def _let_go(self, *, at_once: bool = False) -> None:
        for due_s, pid in list(self._lets_go):
            if at_once or time.monotonic() >= due_s:
                self._lets_go.remove((due_s, pid))
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGCONT)

    def _look_for_those_hit(self) -> None:
        if not self._open:
            return
        there = self._processes()
        for one in list(self._open):
            blow, pid, struck_s, into_s = one
            took_s = time.monotonic() - struck_s
            if blow.way == PAUSE:
                is_back = process_state(pid) in "SRD"
            else:
                new = there.get(blow.name)
                is_back = new is not None and new.pid != pid and process_state(pid) in "XZ"
            if is_back or took_s > BACK_WITHIN_S:
                self._open.remove(one)
                self._soak.add("blow", at_s=round(self._at_s - took_s, 3), mission=self._number,
                               into_s=into_s, name=blow.name, way=blow.way, pid=pid,
                               back_s=round(took_s, 3) if is_back else None, absent=False)

    def _sample(self, into_s: float) -> None:
        self._sampled_s = time.monotonic()
        used = {}
        for name, pid in {LAUNCHER: self._run.process.pid, **{
                p.names[0]: p.pid for p in find_processes(self._run.port)}}.items():
            if (figures := usage(pid)) is not None:
                used[name] = figures
        self._soak.add("sample", at_s=self._at_s, mission=self._number, into_s=round(into_s, 2),
                       used=used)


def usage(pid: int) -> tuple[int, int, int, int] | None:
    """Return a process's own memory and share (kB), descriptors, threads; None if it is gone."""
    proc = Path(f"/proc/{pid}")
    try:
        rolled = dict(line.split()[:2] for line in
                      (proc / "smaps_rollup").read_text().splitlines()[1:])
        threads = next(line for line in (proc / "status").read_text().splitlines()
                       if line.startswith("Threads:"))
        own = int(rolled["Private_Clean:"]) + int(rolled["Private_Dirty:"])
        return own, int(rolled["Pss:"]), sum(1 for _ in (proc / "fd").iterdir()), int(
            threads.split()[1])
    except (OSError, KeyError, StopIteration):
        return None


def one_mission(directory: Path, soak: Soak, options: argparse.Namespace) -> bool:
    """Make a mission; tell whether it was safe. Its directory is kept if not."""
    number = soak.missions
    planned = plan(load(), options.seed, number, LONGEST_S)
    faults = [word for fault in planned.faults for word in ("--fault", fault.text())]
    directory.mkdir(parents=True)
    begun_s = soak.lasted_s
    soak.add("begin", at_s=begun_s, mission=number, utc=datetime.now(UTC).isoformat())
    with RealRun(directory, str(SYSTEM), "--mission", str(write_laps(directory, options.laps)),
                 "--rate", f"{options.rate:g}", "--hmi-port", str(free_base_port()),
                 "--seed", str(options.seed + number), "--patience", "90", *faults,
                 hmi=True) as run:
        mission = Mission(run, soak, number, planned, 3600 * options.hours)
        was_cut = mission.through()
        if was_cut:
            run.process.send_signal(signal.SIGTERM)
        try:
            code, result = run.result(END_WITHIN_S)
        except (AssertionError, subprocess.TimeoutExpired) as error:
            code, result = -1, {"mission": "fail", "safety": "not known", "duration_s": 0.0,
                                "reasons": [f"no verdict: {type(error).__name__}"]}
        lasted_s = round(mission._at_s, 3)
    left = [str(process) for process in find_processes(run.port)]
    _latencies(soak, number, result, planned)
    is_safe = result["safety"] == "safe"
    kept = Path(options.file).with_suffix("") / f"mission-{number}"
    if not is_safe:
        shutil.copytree(directory, kept, dirs_exist_ok=True)
    soak.add("mission", at_s=lasted_s, mission=number, verdict=result["mission"], cut=was_cut,
             safety=result["safety"], code=code, reasons=result["reasons"],
             duration_s=result["duration_s"], resets=mission.resets, left=left,
             behind=(result.get("keeping_up") or {}).get("behind_s", 0.0),
             kept="" if is_safe else str(kept))
    say(f"mission {number}: {'cut' if was_cut else result['mission']}, {result['safety']}, "
        f"{result['duration_s']:.0f} s, {mission.resets} resets; {lasted_s / 60:.1f} min of soak")
    return is_safe


def _latencies(soak: Soak, number: int, result: dict[str, Any], planned: Plan) -> None:
    """Keep how soon each fault was detected and over, from the record of the mission."""
    try:
        record = json.loads(Path(result["record"]).read_text(encoding="utf-8"))
    except (KeyError, OSError, TypeError, ValueError):
        return
    bars = record["intervals"]
    for blow in soak.of("blow"):
        at_s = blow["into_s"]
        found = [b for b in bars if b["lane"] == "down" and b["name"] == blow["name"]
                 and at_s <= b["from_s"] <= at_s + EVERY_S] if blow["mission"] == number else []
        if found:
            soak.add("latency", mission=number, into_s=at_s, what=f"{blow['way']} {blow['name']}",
                     detected_s=round(found[0]["from_s"] - at_s, 3),
                     over_s=round(found[0]["to_s"] - at_s, 3))
    for fault, outcome in zip(planned.faults, record["faults"], strict=False):
        at_s = outcome["injected_s"]
        if at_s is None:
            continue
        ends_s = at_s + (fault.duration_s or 0.0) + 1.0
        found = [b for b in bars if b["lane"] == "detection" and at_s <= b["from_s"] <= ends_s]
        soak.add("latency", mission=number, into_s=at_s, what=fault.fault,
                 affected=outcome["affected"],
                 detected_s=round(found[0]["from_s"] - at_s, 3) if found else None,
                 over_s=round(max(b["to_s"] for b in found) - at_s, 3) if found else None)


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
    parser.add_argument("--summary", action="store_true", help="read the file only, and draw")
    options = parser.parse_args(arguments)
    if not 0 < options.hours < 1000:
        parser.error(f"--hours {options.hours:g}: must be above 0 and below 1000")
    soak = Soak(options.file, options.seed)
    if not options.summary:
        with tempfile.TemporaryDirectory() as folder:
            while soak.lasted_s < 3600 * options.hours - 1:
                if not one_mission(Path(folder) / f"run{soak.missions}", soak, options):
                    break
    lines = summary(soak.records)
    for line in lines:
        say(line)
    if soak.of("sample"):
        for file in write_page(soak.records, lines, options.file):
            say(file)
    return int(bool(wrong(soak.records)))


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # its mission ends with it
    sys.exit(main())
