#!/usr/bin/env python3
"""Start the robot: build the system from its spec, run a mission, judge it, report on it."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import os
import signal
import socket
import sys
import tempfile
import time
import uuid
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec

from rampart import systems
from rampart.actors.bus.topic import Topic
from rampart.actors.layout.layout import Layout, application_class, load_application
from rampart.actors.layout.system_topics import system_topics
from rampart.actors.layout.wiring import load_class
from rampart.actors.recording.bag_writer import BagError, check_target
from rampart.actors.recording.process import Order, RecorderProcess
from rampart.actors.recording.virtual import VirtualRecording
from rampart.actors.run.application import Application
from rampart.actors.run.run_context import RunContext
from rampart.actors.run.run_plan import DEFAULT_PORT, RunPlan, load_document, load_system
from rampart.actors.supervision.launcher import LaunchError
from rampart.actors.web.access import Access, AccessError, is_loopback, new_token
from rampart.actors.web.token_file import SecretError, read_secret
from rampart.cli import application_options
from rampart.cli.output import UsageError
from rampart.files import streams, working_folder
from rampart.files.plain_text import one_line
from rampart.manager.spec.specification import SystemSpec
from rampart.manager.strategies.registry import STRATEGIES
from rampart.sim.faults.faults import faults_of
from rampart.sim.faults.injector import can_be_hit
from rampart.sim.faults.scenario import action_of, parse_fault
from rampart.sim.runs.process_run import ProcessRun
from rampart.sim.runs.record import RunRecord
from rampart.sim.runs.report import in_words
from rampart.sim.runs.trial import trial_class
from rampart.sim.runs.virtual_run import LEAD_S, VirtualRun
from rampart.sim.virtual.network import NETWORKS, find_network

ROOT = Path(__file__).resolve().parents[1]
LAST_PORT = 32_000
ERROR_LOG = "errors.log"
TOKEN_VARIABLE = "RAMPART_HMI_TOKEN"  # noqa: S105 the name of one
HMI = "rampart.actors.operator.hmi:Hmi"
EXIT_SUCCESS, EXIT_FAILED, EXIT_USAGE, EXIT_UNSAFE, EXIT_NOT_KNOWN = 0, 1, 2, 3, 4

EPILOG = """\
examples:
  python launch.py                                  mission AB on the shipped airport
  python launch.py --mission A --obstacles 2        two obstacles on the way
  python launch.py --rate 4 --no-hmi --json         four times real time, result as JSON
  python launch.py --hmi-host 0.0.0.0               the page for other machines too, with a token
  python launch.py --hmi-token-file FILE            the page for others, with a token of yours
  python launch.py --record run.mcap                keep everything that is said; `rampart replay`
  python launch.py --no-ftm                         the paper's baseline, without fault tolerance
  python launch.py --joystick                       drive by hand: hold the left shoulder button
  python launch.py --virtual --seed 7               in seconds, and every time the same
  python launch.py --virtual --fault kill:osmosis_control@30 --fault gps-bias@goal2+5
  python launch.py --system paper                   the paper's mechanisms and no more
  python launch.py --system cell                    the manipulator cell, with stand-in nodes
  python launch.py --airport my/airport.graph --mission my/MISSION_A.miss
while it runs, from another shell:
  kill-node osmosis_control                         kill a node and watch it come back
  rampart inject localization-not-updated           inject one of the paper's faults
  rampart status                                    what the robot and its nodes are doing
exit code: 0 success and safe, 1 mission failed but safe, 2 bad usage or spec, 3 unsafe,
4 safety not known: no ground truth ever came. A report that cannot be written and output that
nobody reads change none of them; with --json, "report_error" says why there is no "report"
"""


def parser(kind: type[Application] = Application, said: Mapping[str, Any] | None = None
           ) -> argparse.ArgumentParser:
    """Return the parser of the command line.

    Args:
        kind: the application of the system that is started, which adds options.
        said: what the system's spec says of them.
    """
    p = argparse.ArgumentParser(
        prog="launch.py", description=__doc__, epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--wait", action="store_true",
                   help="let the operator start the mission from the page")
    p.add_argument("--system", metavar="FILE", default=str(systems.DEFAULT),
                   help=f"system spec, or name of a shipped one: {systems.names()} "
                   "(default: osmosis)")
    p.add_argument("--strategy", metavar="NAME", default="",
                   help=f"one of {', '.join(STRATEGIES)} (default: the system's)")
    p.add_argument("--shadow", metavar="NAME", default="",
                   help="a second strategy that decides without effect; where it differs, it says "
                   "so (default: the system's)")
    p.add_argument("--no-ftm", action="store_true",
                   help="run the paper's unprotected baseline: last command kept, no dead man, "
                   "no respawn")
    p.add_argument("--rate", metavar="R", type=float, default=1.0,
                   help="simulated seconds per second (default: 1)")
    p.add_argument("--seed", metavar="N", type=int, default=1, help="for sensor noise (default: 1)")
    p.add_argument("--no-hmi", action="store_true", help="no operator's page (its node still runs)")
    p.add_argument("--hmi-port", metavar="PORT", type=int, default=8080,
                   help="port of the operator's page (default: 8080)")
    p.add_argument("--hmi-host", metavar="HOST", default="127.0.0.1",
                   help="address of the operator's page (default: 127.0.0.1, this machine only). "
                   "Any other makes it need a token, which is printed with the page's address "
                   "when the run starts")
    p.add_argument("--hmi-token-file", metavar="FILE", default="",
                   help="a file of yours, of mode 0600, with that token, 16 characters or more, to "
                   f"keep it over several runs; or set {TOKEN_VARIABLE} to it (default: a random "
                   "one; for yourself on this machine none is needed)")
    p.add_argument("--hmi-token", nargs="?", const="", help=argparse.SUPPRESS)  # refused
    p.add_argument("--port", metavar="PORT", type=int, default=DEFAULT_PORT,
                   help="number that tells runs on this machine apart; no port is opened "
                   f"(default: {DEFAULT_PORT})")
    p.add_argument("--patience", metavar="S", type=float, default=60.0,
                   help="simulated seconds without progress after which the mission counts as "
                   "failed (default: 60)")
    p.add_argument("--duration", metavar="S", type=float,
                   help="simulated seconds after which a system without a mission ends (default: "
                   "when it is interrupted)")
    p.add_argument("--record", metavar="FILE", help="keep everything that is sent in an MCAP file, "
                   "for `rampart bag info`, `rampart replay` and Foxglove-compatible viewers")
    p.add_argument("--overwrite", action="store_true", help="--record may replace an existing file")
    p.add_argument("--report", metavar="DIR", help="where the report goes, checkpoints, and in "
                   f"{ERROR_LOG} the tracebacks of nodes that failed (default: "
                   "reports/TIME-MISSION, without a mission reports/TIME-SYSTEM)")
    p.add_argument("--virtual", action="store_true",
                   help="run a mission in virtual time: all actors in this process, many times "
                   "faster than real; the same --seed gives the same run, to the byte")
    p.add_argument("--network", metavar="NAME", default="measured",
                   help=f"with --virtual, what lies between the nodes: {', '.join(NETWORKS)} "
                   "(default: measured)")
    p.add_argument("--fault", metavar="FAULT[@WHEN][+S]", action="append", default=[],
                   help="a fault to inject into a mission (repeatable): one of `rampart inject "
                   "--list`, MODE:TOPIC, kill:NODE, stop:NODE, wedge:NODE, slow:NODE, stuck-wheel, "
                   "weak-wheel, brake-failure, obstacle-ahead; WHEN is simulated seconds or goalN "
                   "(default: 10), S how long it lasts")
    p.add_argument("--json", action="store_true",
                   help="last line of stdout is one JSON object with the result")
    application_options.add(p, kind, said or {})
    return p


class Run:
    """One run from the parsed options to the exit code, on processes or in virtual time."""

    def __init__(self, options: argparse.Namespace, plan: RunPlan, spec: SystemSpec) -> None:
        self._options = options
        kind = trial_class(spec)
        if kind.judges and options.duration is not None:
            raise UsageError(f"--duration {options.duration:g}: a mission ends by itself; "
                             "--patience S ends one that makes no progress")
        if not kind.judges:
            _refuse(options, ("fault", "virtual", "wait", "patience"),
                    f"{spec.name} has no mission: its [application] names no class with one")
        application = load_application(plan, spec)
        if note := application.check(spec, virtual=options.virtual):
            _say(note)
        run = RunContext(plan, spec, load_document(plan), application)
        self._directory = _directory(options, kind(run).name)
        plan = msgspec.structs.replace(
            plan,
            error_log=str(self._directory.resolve() / ERROR_LOG),
            checkpoints=str(self._directory.resolve() / "checkpoints"))
        self._trial = kind(replace(run, plan=plan),
                           options.patience if kind.judges else options.duration, sys.stderr)
        self._plan = plan
        self._scenario = [parse_fault(text) for text in options.fault]
        known: Sequence[Topic[Any]] = ()
        if self._scenario:
            Layout(plan, spec)  # names file and path of an actor that cannot be had
            known = system_topics(spec)
        for i, planned in enumerate(self._scenario):
            action_of(planned, f"f{i}", can_be_hit(spec), known, faults_of(spec))  # not in mid-run
            if planned.goal > self._trial.goals:
                raise UsageError(f"--fault {planned.text()}: mission {self._trial.name} has "
                                 f"{self._trial.goals} goals")

    def on_processes(self) -> int:
        """Run on processes and return the exit code.

        Raises:
            LaunchError: the system cannot be started.
        """
        return asyncio.run(self._on_processes())

    async def _on_processes(self) -> int:
        run = ProcessRun(self._trial, self._scenario)
        with _kept(self._directory), _recorded(self._options):
            _interruptible(run)
            record = await run.run()
            return self._conclude(record, run.failure)

    def in_virtual_time(self) -> int:
        """Run in virtual time and return the exit code."""
        with _kept(self._directory):
            return self._in_virtual_time()

    def _in_virtual_time(self) -> int:
        recording = None
        if self._options.record:
            recording = VirtualRecording(
                Path(self._options.record), self._plan.description, self._trial.title,
                nodes=Layout(self._plan, self._trial.run.system).members, lead_s=LEAD_S,
                overwrite=self._options.overwrite)
        run = VirtualRun(self._trial, scenario=self._scenario,
                         network=find_network(self._options.network),
                         taps=[recording.take] if recording else [])
        console = self._trial.console
        if console is None:
            raise TypeError("a run from the command line tells its story")
        console.banner(self._trial.about, self._plan, self._trial.run.system, virtual=True)
        try:
            with _interruptible_between_bytecodes(run):
                result = run.run()
        finally:
            console.close()
            if recording is not None:
                _say(recording.close())
        console.speed(result.speed, result.messages, result.trace)
        for name, error in result.failures:
            _say(f"{name} failed: {one_line(error)}")
        if result.tracebacks:
            try:
                with Path(self._plan.error_log).open("a", encoding="utf-8") as log:
                    log.write(result.tracebacks)
            except OSError as error:
                _say(f"{self._plan.error_log}: tracebacks are lost: {in_words(error)}")
        return self._conclude(result.record, trace=result.trace)

    def _conclude(self, record: RunRecord, failure: str = "", **more: str | None) -> int:
        """Tell what came of the run; no disk and no reader that fails changes the verdict."""
        report = self._trial.report(record, self._directory)
        if self._trial.console:
            self._trial.console.conclusion(record, report.html)
        if report.problem:
            _say(f"report: {report.problem}")
        for fault in record.faults:
            if not fault.effective:
                _say(f"fault {fault.fault} had no effect: {one_line(fault.reason)}")
        if self._options.json:
            if self._trial.judges:
                more |= {"report": str(report.html) if report.html else None,
                         "record": str(report.data) if report.data else None,
                         "report_error": report.problem or None}
            _print_result({**self._trial.summary(record), **more})
        if not self._trial.judges:
            return EXIT_FAILED if failure else EXIT_SUCCESS
        if record.safety != "safe":
            return EXIT_UNSAFE if record.safety == "unsafe" else EXIT_NOT_KNOWN
        return EXIT_SUCCESS if record.mission == "success" else EXIT_FAILED


def _say(text: str) -> None:
    print("launch.py: " + " ".join(text.split()), file=sys.stderr, flush=True)


def _print_result(result: dict[str, Any]) -> None:
    print(json.dumps(result), flush=True)
    if why := streams.lost_result():
        _say(f"stdout: {why}: the result is lost")


@contextlib.contextmanager
def _kept(directory: Path) -> Iterator[None]:
    """Have a directory for what is kept of a run: say if there are tracebacks, leave none empty.

    Raises:
        UsageError: it cannot be made, or not be written.
    """
    log = directory / ERROR_LOG
    made = not directory.exists()
    try:
        directory.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=directory).close()
    except OSError as error:
        raise UsageError(f"--report {directory}: no directory that can be written "
                         f"({error.strerror})") from None
    before = _size(log)
    try:
        yield
    finally:
        if _size(log) > before:
            _say(f"tracebacks of what failed: {log}")
        if made:
            with contextlib.suppress(OSError):  # there is something in it
                directory.rmdir()


def _size(file: Path) -> int:
    try:
        return file.stat().st_size
    except OSError:
        return 0


@contextlib.contextmanager
def _recorded(options: argparse.Namespace) -> Iterator[None]:
    """Have what runs meanwhile recorded, if that is asked for, by a process of its own."""
    recorder = None
    if options.record:
        recorder = RecorderProcess(Order(options.port, str(Path(options.record).resolve()),
                                         os.getpid(), options.overwrite))
        recorder.start()
    try:
        yield
    finally:
        if recorder is not None:
            recorder.end()


def _interruptible(run: ProcessRun) -> None:
    """Have SIGINT, SIGTERM, and the end of the terminal, end a run; the second one is meant."""

    def interrupt(name: str) -> None:
        if run.interrupted:
            run.launcher.abort()
            raise SystemExit(EXIT_FAILED)
        run.interrupted = f"interrupted by {name}"

    for number in _ends():
        asyncio.get_running_loop().add_signal_handler(
            number, interrupt, signal.Signals(number).name)


def _ends() -> list[signal.Signals]:
    """Return the signals that end a run; under nohup the end of the terminal does not."""
    ends = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]
    return [number for number in ends if signal.getsignal(number) is not signal.SIG_IGN]


@contextlib.contextmanager
def _interruptible_between_bytecodes(run: VirtualRun) -> Iterator[None]:
    """As `_interruptible`, for a loop that never waits and so reads no signals from its pipe."""

    def interrupt(number: int, _frame: object) -> None:
        if run.interrupted:
            raise KeyboardInterrupt
        run.interrupted = f"interrupted by {signal.Signals(number).name}"

    before = {number: signal.signal(number, interrupt) for number in _ends()}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _parse(arguments: Sequence[str] | None) -> tuple[argparse.Namespace, type[Application]]:
    """Return the options, those of the system's application included, and its class.

    Raises:
        UsageError: there is no such system, or an option that it does not have.
        ValueError: the system's spec is unsound.
    """
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    first.add_argument("--system", default=str(systems.DEFAULT))
    system = str(first.parse_known_args(arguments)[0].system)
    spec = load_system(RunPlan(system_file=str(_system_file(system))))
    kind = application_class(spec)
    options, unknown = parser(kind, spec.application).parse_known_args(arguments)
    if unknown:
        raise UsageError(f"{unknown[0]}: no option of the launcher or of {spec.name}; --system "
                         f"{system} --help shows those there are")
    return options, kind


def _system_file(system: str) -> Path:
    found = systems.find(system)
    if not found.is_file():
        what = "is a directory" if found.is_dir() else "no such file"
        raise UsageError(f"--system {system}: {what}; a spec is right, or the name of a "
                         f"shipped one: {systems.names()}")
    return found


def _plan(options: argparse.Namespace, kind: type[Application]) -> tuple[RunPlan, SystemSpec]:
    """Return the plan that the options ask for, and the system they name."""
    system_file = _system_file(options.system)
    token, token_is_new = _token(options)
    plan = RunPlan(
        run_id=uuid.uuid4().hex[:12], base_port=options.port, rate=options.rate,
        seed=options.seed, system_file=str(system_file.resolve()), strategy=options.strategy,
        ftm=not options.no_ftm, options=application_options.chosen(options, kind),
        hmi_port=0 if options.no_hmi else options.hmi_port, shadow=options.shadow,
        hmi_host=options.hmi_host, hmi_token=token,
        hmi_token_is_new=token_is_new,
        waits=options.wait)
    spec = load_system(plan)
    if not options.no_hmi:
        plan = msgspec.structs.replace(plan, faults=faults_of(spec).offered())
    return _fitting(options, plan, spec), spec


def _fitting(options: argparse.Namespace, plan: RunPlan, spec: SystemSpec) -> RunPlan:
    """Return the plan without a page that nobody serves.

    Raises:
        UsageError: an option needs a node that the system has not.
    """
    if not _has_actor(plan, spec, HMI):
        _refuse(options, ("wait", "hmi_port", "hmi_host", "hmi_token_file"),
                f"no node of {spec.name} serves an operator's page")
        plan = msgspec.structs.replace(plan, hmi_port=0)
    return plan


def _has_actor(plan: RunPlan, spec: SystemSpec, actor: str) -> bool:
    """Tell whether a node of the system is of this class, or of one that is derived from it."""
    return any(node.actor == actor for node in spec.nodes) or any(
        issubclass(member.actor, load_class(actor))
        for member in Layout(plan, spec).members.values())


def _refuse(options: argparse.Namespace, names: Sequence[str], why: str) -> None:
    """Refuse options that would have no effect, each by its name and value as it is typed."""
    for name in names:
        value = getattr(options, name)
        if value == parser().get_default(name):
            continue
        shown = value[0] if isinstance(value, list) else value
        text = "" if value is True else f" {shown:g}" if isinstance(shown, float) else f" {shown}"
        raise UsageError(f"--{name.replace('_', '-')}{text}: {why}")


def _directory(options: argparse.Namespace, name: str) -> Path:
    """Return where the report of a run goes; it is made when the run starts."""
    if options.report:
        return Path(options.report)
    return ROOT / "reports" / f"{time.strftime('%Y%m%d-%H%M%S')}-{name}"


def _check(options: argparse.Namespace) -> None:
    if not 0.1 <= options.rate <= 20:
        raise UsageError(f"--rate {options.rate:g}: must be between 0.1 and 20")
    if options.duration is not None and not 0 < options.duration < 1e9:
        raise UsageError(f"--duration {options.duration:g}: must be above 0")
    if not options.patience > 0:
        raise UsageError(f"--patience {options.patience:g}: must be above 0")
    if options.record:
        check_target(Path(options.record), overwrite=options.overwrite)
    elif options.overwrite:
        raise UsageError("--overwrite: only with --record FILE")
    for name, port in (("--port", options.port), ("--hmi-port", options.hmi_port)):
        if not 1024 <= port <= LAST_PORT:
            raise UsageError(f"{name} {port}: must be between 1024 and {LAST_PORT}, below the "
                             "ports that the kernel gives to outgoing connections")
    if options.network != "measured" and not options.virtual:
        raise UsageError(f"--network {options.network}: only with --virtual; Zenoh carries the "
                         "messages of real processes")
    if options.virtual and options.network not in NETWORKS:
        raise UsageError(f"--network {options.network}: unknown; known: {', '.join(NETWORKS)}")
    for option, name in (("--strategy", options.strategy), ("--shadow", options.shadow)):
        if name and name not in STRATEGIES:
            raise UsageError(f"{option} {name}: unknown strategy; known: {', '.join(STRATEGIES)}")


def _token(options: argparse.Namespace) -> tuple[str, bool]:
    """Return what the operator's page asks for, and whether it is new and has to be printed.

    It comes from a file or the environment, which other users cannot read as they can read a
    command line; where none is given and one is needed it is made.
    """
    host: str = options.hmi_host
    own = os.environ.pop(TOKEN_VARIABLE, "")  # not for whatever is started
    if options.hmi_token is not None:
        raise UsageError("--hmi-token: a command line is read by every user of this machine; put "
                         "another token into a file of mode 0600 for --hmi-token-file FILE, or "
                         f"into the variable {TOKEN_VARIABLE}")
    if options.no_hmi or options.virtual:
        if options.wait:
            raise UsageError("--wait: the mission is started from the operator's page, which there "
                             f"is not with --{'no-hmi' if options.no_hmi else 'virtual'}")
        return "", False
    source = TOKEN_VARIABLE
    try:
        if options.hmi_token_file:
            source = f"--hmi-token-file {options.hmi_token_file}"
            own = read_secret(Path(options.hmi_token_file))
        token = own or ("" if is_loopback(host) else new_token())
        Access(host, options.hmi_port, token)
    except (AccessError, SecretError) as error:
        raise UsageError(f"{source}: {error}") from None
    try:
        family, kind, number, _, address = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, number) as probe:
            probe.bind(address)
    except (OSError, UnicodeError) as error:
        why = getattr(error, "strerror", None) or str(error)
        raise UsageError(f"--hmi-host {host}: no address of this machine ({why}); 0.0.0.0 stands "
                         "for all it has") from None
    return token, bool(token) and not own


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line, run, and return the exit code."""
    streams.secure()
    working_folder.admit()  # for actors of one's own, as in the processes of a run
    try:
        options, kind = _parse(arguments)
        _check(options)
        plan, spec = _plan(options, kind)
        run = Run(options, plan, spec)
        return run.in_virtual_time() if options.virtual else run.on_processes()
    except (UsageError, LaunchError, BagError, ValueError, OSError) as error:
        _say(str(error))
        return EXIT_USAGE
    except KeyboardInterrupt:
        return EXIT_FAILED


if __name__ == "__main__":
    sys.exit(main())
