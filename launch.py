#!/usr/bin/env python3
"""Start the robot: build the system from its spec, run a mission, judge it, report on it."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import signal
import sys
import uuid
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec

from actors import topics
from actors.messages import ControlStatus, GroundTruth, MissionStatus, NodeTable, ProcessEvent
from actors.runtime.actor import Context, Header
from actors.runtime.clock import Clock
from actors.runtime.topic import Topic
from actors.runtime.zenoh_bus import ZenohBus, endpoint
from actors.supervision.launcher import Launcher, LaunchError
from actors.supervision.run_plan import DEFAULT_PORT, OBSERVER, RunPlan, load_system
from airport.formats import load_airport, load_mission
from airport.model import Airport, Mission
from manager.specification import SystemSpec
from manager.strategies import STRATEGIES
from sim.console import Console
from sim.judge import Judge
from sim.observer import JudgeSink, Observer
from sim.report import write_report
from sim.report_record import RunRecord, RunRecorder
from sim.run_end import RunEnd
from sim.watched_run import WatchedRun, new_directory

ROOT = Path(__file__).resolve().parent
LAST_PORT = 32_000
EXIT_SUCCESS, EXIT_FAILED, EXIT_USAGE, EXIT_UNSAFE = 0, 1, 2, 3

EPILOG = """\
examples:
  python launch.py                                  mission AB on the shipped airport
  python launch.py --mission A --obstacles 2        two obstacles on the way
  python launch.py --rate 4 --no-hmi --json         four times real time, result as JSON
  python launch.py --no-ftm                         the paper's baseline, without fault tolerance
  python launch.py --system cell                    the manipulator cell, with stand-in nodes
  python launch.py --airport my/airport.graph --mission my/MISSION_A.miss
while it runs, from another shell:
  kill-node osmosis_control                         kill a node and watch it come back
  rampart inject localization-not-updated           inject one of the paper's faults
  rampart status                                    what the robot and its nodes are doing
exit code: 0 success and safe, 1 mission failed but safe, 2 bad usage or spec, 3 unsafe
"""


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    p = argparse.ArgumentParser(
        prog="launch.py", description=__doc__, epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--mission", metavar="NAME|FILE", help="mission of the airport, or a file with "
                   "lines x=…,y=…,taxi=… (default: the system's)")
    p.add_argument("--airport", metavar="NAME|FILE", help="shipped airport, a .toml, or a .graph "
                   "with its image beside it (default: the system's)")
    p.add_argument("--system", metavar="FILE", default=str(ROOT / "systems" / "osmosis.toml"),
                   help="system spec, or name of a shipped one: osmosis, cell (default: osmosis)")
    p.add_argument("--strategy", metavar="NAME", default="",
                   help=f"one of {', '.join(STRATEGIES)} (default: the system's)")
    p.add_argument("--shadow", metavar="NAME", default="",
                   help="a second strategy that decides without effect; where it differs, it says "
                   "so (default: the system's)")
    p.add_argument("--obstacles", metavar="N", type=int, default=0,
                   help="how many of the airport's obstacles stand on the way (default: 0)")
    p.add_argument("--no-ftm", action="store_true",
                   help="run the paper's unprotected baseline: last command kept, no dead man, "
                   "no respawn")
    p.add_argument("--rate", metavar="R", type=float, default=1.0,
                   help="simulated seconds per second (default: 1)")
    p.add_argument("--seed", metavar="N", type=int, default=1, help="for sensor noise (default: 1)")
    p.add_argument("--no-hmi", action="store_true", help="no operator's page (its node still runs)")
    p.add_argument("--hmi-port", metavar="PORT", type=int, default=8080,
                   help="port of the operator's page on loopback (default: 8080)")
    p.add_argument("--port", metavar="PORT", type=int, default=DEFAULT_PORT,
                   help=f"first of the run's Zenoh ports on loopback (default: {DEFAULT_PORT})")
    p.add_argument("--patience", metavar="S", type=float, default=60.0,
                   help="simulated seconds without progress after which the mission counts as "
                   "failed (default: 60)")
    p.add_argument("--duration", metavar="S", type=float,
                   help="simulated seconds after which a system without a mission ends (default: "
                   "when it is interrupted)")
    p.add_argument("--report", metavar="DIR", help="where the report goes (default: "
                   "reports/TIME-MISSION)")
    p.add_argument("--json", action="store_true",
                   help="last line of stdout is one JSON object with the result")
    return p


class UsageError(Exception):
    """One line for the user; exit code 2."""


class Run:
    """One run from the parsed options to the exit code."""

    def __init__(self, options: argparse.Namespace, plan: RunPlan, spec: SystemSpec) -> None:
        self._options = options
        self.spec = spec
        if options.duration is not None:
            raise UsageError(f"--duration {options.duration:g}: a mission ends by itself; "
                             "--patience S ends one that makes no progress")
        airport_name = _existing_path(options.airport or self.spec.airport)
        mission_name = _existing_path(options.mission or self.spec.mission)
        self.airport: Airport = load_airport(airport_name)
        self.mission: Mission = load_mission(mission_name, self.airport)
        if options.obstacles > len(self.airport.obstacles):
            raise UsageError(f"--obstacles {options.obstacles}: {self.airport.name} has places for "
                             f"{len(self.airport.obstacles)}")
        self.directory = Path(options.report) if options.report else new_directory(
            ROOT / "reports", self.mission.name)
        self.directory.mkdir(parents=True, exist_ok=True)
        self.launcher = Launcher(
            msgspec.structs.replace(plan, airport=airport_name, mission=mission_name,
                                    error_log=str(self.directory.resolve() / "errors.log")),
            f"{self.mission.name} on {self.airport.name}")
        self.judge = Judge(self.mission.goals)
        self.end = RunEnd(options.patience)
        self.console = Console(sys.stderr)
        self._interrupted = ""
        self._guards_restarted = 0

    async def run(self) -> int:
        """Run the mission and return the exit code.

        Raises:
            LaunchError: the system cannot be started.
        """
        loop = asyncio.get_running_loop()
        self.launcher.begin()
        for number in (signal.SIGINT, signal.SIGTERM):
            loop.add_signal_handler(number, self._interrupt, signal.Signals(number).name)
        try:
            await self.launcher.load()
            await self.launcher.start()
            return await self._observe()
        finally:
            await self.launcher.end()

    def _interrupt(self, name: str) -> None:
        if self._interrupted:  # the second time it is meant
            self.launcher.abort()
            raise SystemExit(EXIT_FAILED)
        self._interrupted = f"interrupted by {name}"

    async def _observe(self) -> int:
        plan = self.launcher.plan
        clock = Clock(plan.origin_s, plan.rate)
        recorder = RunRecorder(
            plan.run_id, self.airport, self.mission, seed=plan.seed, rate=plan.rate,
            strategy=self.spec.strategy if plan.ftm else "")

        def brought_back(name: str) -> None:
            self._guards_restarted += 1
            self.console.line(clock.now(), f"{name} brought back")
            recorder.feed(
                topics.PROCESS_EVENT,
                ProcessEvent(name, "respawned", 0, self._guards_restarted, "launch.py", ""),
                Header("launch.py", 1, self._guards_restarted, clock.now()))

        self.launcher.on_restart = brought_back

        def to_launcher(_topic: Topic[Any], message: Any, _header: Header) -> None:
            if isinstance(message, NodeTable):
                self.launcher.supervisor_heard(message)

        def to_end(_topic: Topic[Any], message: Any, _header: Header) -> None:
            if isinstance(message, MissionStatus):
                self.end.mission(message, clock.now())
            elif isinstance(message, ControlStatus):
                self.end.control(message, clock.now())
            elif isinstance(message, GroundTruth):
                self.end.truth(clock.now())

        ports = dict(self.launcher.ports)
        bus = ZenohBus(OBSERVER, 1, endpoint(ports.pop(OBSERVER)), map(endpoint, ports.values()))
        sinks = [to_launcher, to_end, JudgeSink(self.judge), recorder.feed, self.console.take]
        observer = Observer(Context(OBSERVER, 1, clock, bus, {}, {"sinks": sinks}))
        task = asyncio.create_task(observer.run())
        self.console.banner(self.airport.name, self.mission, plan, self.spec.strategy)
        try:
            why = None
            while why is None and not self._interrupted and not task.done():
                await asyncio.sleep(0.05)
                why = self.end.ended(clock.now())
            if task.done():
                await task
        finally:
            observer.stop()
            await asyncio.gather(task, return_exceptions=True)
            self.console.close()
        return self._conclude(recorder, clock.now(), self._interrupted or why or "ended")

    def _conclude(self, recorder: RunRecorder, now_s: float, why: str) -> int:
        verdict = self.judge.verdict()
        reasons = () if verdict.success and verdict.safe else (*verdict.reasons, f"ended: {why}")
        record = recorder.record(
            "success" if verdict.success else "fail", "safe" if verdict.safe else "unsafe",
            reasons, now_s)
        html, data = write_report(record, self.directory)
        self.console.conclusion(record, html)
        if self._options.json:
            print(json.dumps(_summary(record, html, data)), flush=True)
        if not verdict.safe:
            return EXIT_UNSAFE
        return EXIT_SUCCESS if verdict.success else EXIT_FAILED


def _summary(record: RunRecord, html: Path, data: Path) -> dict[str, Any]:
    """Return what scripts rely on: the last line of stdout with --json."""
    return {
        "mission": record.mission, "safety": record.safety, "reasons": list(record.reasons),
        "duration_s": round(record.duration_s, 2),
        "lights": [msgspec.to_builtins(light) for light in record.lights],
        "decisions": [msgspec.to_builtins(decision) for decision in record.decisions],
        "restarts": record.restarts, "report": str(html), "record": str(data),
    }


def _plan(options: argparse.Namespace) -> tuple[RunPlan, SystemSpec]:
    """Return the plan that the options ask for, and the system they name."""
    system_file = Path(options.system)
    shipped = ROOT / "systems" / f"{options.system}.toml"
    if not system_file.is_file() and shipped.is_file():
        system_file = shipped
    if not system_file.is_file():
        raise UsageError(f"--system {options.system}: no such file")
    plan = RunPlan(
        run_id=uuid.uuid4().hex[:12], base_port=options.port, rate=options.rate,
        seed=options.seed, system_file=str(system_file.resolve()), strategy=options.strategy,
        airport="", mission="", obstacles=options.obstacles, ftm=not options.no_ftm,
        hmi_port=0 if options.no_hmi else options.hmi_port, shadow=options.shadow)
    return plan, load_system(plan)


async def _watch(options: argparse.Namespace, plan: RunPlan, spec: SystemSpec) -> int:
    """Run a system that drives nowhere, until its time is over or somebody ends it."""
    for option in ("mission", "airport", "obstacles"):
        if getattr(options, option):
            raise UsageError(f"--{option} {getattr(options, option)}: {spec.name} has no [robot] "
                             "and drives nowhere")
    directory = Path(options.report) if options.report else new_directory(
        ROOT / "reports", spec.name)
    directory.mkdir(parents=True, exist_ok=True)
    run = WatchedRun(plan, spec, options.duration, directory, sys.stderr)

    def interrupt(name: str) -> None:
        if run.interrupted:  # the second time it is meant
            run.launcher.abort()
            raise SystemExit(EXIT_FAILED)
        run.interrupted = f"interrupted by {name}"

    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(
            number, interrupt, signal.Signals(number).name)
    await run.run()
    if options.json:
        print(json.dumps(run.summary()), flush=True)
    return EXIT_SUCCESS


def _check(options: argparse.Namespace) -> None:
    if not 0.1 <= options.rate <= 20:
        raise UsageError(f"--rate {options.rate:g}: must be between 0.1 and 20")
    if options.obstacles < 0:
        raise UsageError(f"--obstacles {options.obstacles}: must not be negative")
    if options.duration is not None and not 0 < options.duration < 1e9:
        raise UsageError(f"--duration {options.duration:g}: must be above 0")
    if not options.patience > 0:
        raise UsageError(f"--patience {options.patience:g}: must be above 0")
    for name, port in (("--port", options.port), ("--hmi-port", options.hmi_port)):
        if not 1024 <= port <= LAST_PORT:
            raise UsageError(f"{name} {port}: must be between 1024 and {LAST_PORT}, below the "
                             "ports that the kernel gives to outgoing connections")
    for option, name in (("--strategy", options.strategy), ("--shadow", options.shadow)):
        if name and name not in STRATEGIES:
            raise UsageError(f"{option} {name}: unknown strategy; known: {', '.join(STRATEGIES)}")


def _existing_path(name: str) -> str:
    """Return an existing path made absolute, so that every process finds it; names stay names."""
    return str(Path(name).resolve()) if Path(name).exists() else name


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line, run, and return the exit code."""
    options = parser().parse_args(arguments)
    try:
        _check(options)
        plan, spec = _plan(options)
        if spec.mobile is None:
            return asyncio.run(_watch(options, plan, spec))
        return asyncio.run(Run(options, plan, spec).run())
    except (UsageError, LaunchError, ValueError, OSError) as error:
        print("launch.py: " + " ".join(str(error).split()), file=sys.stderr)
        return EXIT_USAGE
    except KeyboardInterrupt:
        return EXIT_FAILED


if __name__ == "__main__":
    with contextlib.suppress(BrokenPipeError):
        sys.exit(main())
