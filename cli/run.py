"""One run from the command line to the exit code: `launch.py`, and `rampart run`."""

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
from collections.abc import Callable, Coroutine, Iterator, Sequence
from contextvars import ContextVar
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, TextIO

import msgspec

from rampart.actors.recording.bag_writer import BagError
from rampart.actors.recording.incidents import state_folder
from rampart.actors.recording.process import Order, RecorderProcess
from rampart.actors.recording.recorder import VirtualRecording
from rampart.actors.runtime.clock import Clock
from rampart.actors.runtime.run_context import RunContext
from rampart.actors.runtime.run_plan import RunPlan, load_document
from rampart.actors.supervision.launcher import LaunchError
from rampart.actors.supervision.root import Root
from rampart.actors.system.layout import Layout
from rampart.actors.system.members import load_application
from rampart.actors.system.topics import system_topics
from rampart.cli.output import FORMAT, UsageError
from rampart.cli.run_options import ERROR_LOG, audited, of_one_process, parse, plan_of, refuse
from rampart.files import loading, streams, working_folder
from rampart.files.plain_text import one_line
from rampart.manager.spec.specification import SystemSpec
from rampart.manager.spec.tables import BlackBox
from rampart.sim.faults.faults import faults_of
from rampart.sim.faults.injector import can_be_hit
from rampart.sim.faults.scenario import action_of, parse_fault
from rampart.sim.runs.process_run import ProcessRun
from rampart.sim.runs.record import RunRecord
from rampart.sim.runs.report import in_words
from rampart.sim.runs.resumption import (
    AFTER_S,
    Manifest,
    ResumptionError,
    RunFiles,
    differences,
    find,
    manifest_of,
)
from rampart.sim.runs.trial import Trial, trial_class
from rampart.sim.runs.virtual_run import LEAD_S, VirtualRun
from rampart.sim.virtual.network import find_network

EXIT_SUCCESS, EXIT_FAILED, EXIT_USAGE, EXIT_UNSAFE, EXIT_NOT_KNOWN = 0, 1, 2, 3, 4

PROGRAM: ContextVar[str] = ContextVar("program", default="launch.py")
"""Name of the command, at the beginning of messages."""


class Run:
    """One run from the parsed options to the exit code, on processes or in virtual time."""

    def __init__(self, options: argparse.Namespace, plan: RunPlan, spec: SystemSpec,
                 reports: Path, *, arguments: Sequence[str] = (),
                 resumed: tuple[RunFiles, Manifest] | None = None) -> None:
        self._options = options
        kind = trial_class(spec)
        if kind.patient and options.duration is not None:
            raise UsageError(f"--duration {options.duration:g}: a mission ends by itself, or by "
                             "--patience S without progress")
        if not kind.patient:
            refuse(options, ("wait", "patience"),
                   f"{spec.name} has no mission: its runs end after --duration S")
            if options.virtual and (options.duration or spec.end.after_s) is None:
                raise UsageError("--virtual: expected --duration S, or an [end] with after_s in "
                                 f"{spec.name}: a run in virtual time has to end")
        application = load_application(plan, spec)
        run = RunContext(plan, spec, load_document(plan), application)
        self._directory = Path(options.report) if options.report else (
            reports / f"{time.strftime('%Y%m%d-%H%M%S')}-{kind(run).name}")
        kept = self._directory.resolve()
        plan = msgspec.structs.replace(
            plan, error_log=str(kept / ERROR_LOG), checkpoints=str(kept / "checkpoints"),
            black_box=black_box_folder(options, spec),
            page=audited(plan.page, kept / f"audit-{plan.run_id}.jsonl"))
        self._kind, self._context = kind, replace(run, plan=plan)
        self._trial = self._made(plan, sys.stderr)
        self._plan = plan
        self._files: RunFiles | None = None
        if not options.virtual and spec.layers.checkpoints and not spec.hosts and kind.resumes:
            self._files = resumed[0] if resumed else RunFiles(self._directory)
        self._manifest = manifest_of(plan, arguments,
                                     [path for _, path in application.documents()])
        if resumed:
            self._resume(resumed[1])
        self._scenario = [parse_fault(text) for text in options.fault]
        known = system_topics(spec) if self._scenario else ()
        for i, planned in enumerate(self._scenario):
            action_of(planned, f"f{i}", can_be_hit(spec), known, faults_of(spec))
            if planned.goal > self._trial.goals:
                raise UsageError(f"--fault {planned.text()}: mission {self._trial.name} has "
                                 f"{self._trial.goals} goals")

    def run(self) -> int:
        """Run and return the exit code.

        Raises:
            LaunchError: the system cannot be started.
        """
        with _kept(self._directory):
            if self._options.virtual:
                return self._in_virtual_time()
            files = self._files
            if files is not None and not files.lock():
                raise UsageError(f"--report {files.directory}: another run keeps its checkpoints "
                                 "there")
            saved = files.saved() if files is not None else None
            try:
                root = Root(self._context)
                code = root.run(lambda link: _in_child(lambda: self._watch(link)))
                if code == EXIT_USAGE and files is not None:
                    with contextlib.suppress(OSError):
                        files.put_back(saved)
                return self._not_watched(root) if code is None else code
            finally:
                if files is not None:
                    files.unlock()

    async def _watch(self, link: socket.socket) -> int:
        keep = None
        if self._files is not None:
            self._files.save(msgspec.structs.replace(self._manifest, rate=self._plan.rate))
            keep = partial(self._files.keep_memory, self._plan.run_id)
        return await self._on_processes(ProcessRun(self._trial, link, self._scenario, keep))

    def _not_watched(self, root: Root) -> int:
        """Conclude a run whose process `run` has ended without a verdict."""
        why = ("the process that watched the run was killed" if root.death else
               "the process that watched the run has failed")
        _say(f"{why}{root.death and f' by {root.death}'}: the run has ended")
        plan = root.plan
        lasted_s = Clock(plan.origin_s, plan.rate).now() if plan.origin_s else 0.0
        record = self._trial.conclude(max(0.0, lasted_s), why)
        return self._conclude(msgspec.structs.replace(
            record, safety="not known", reasons=(*record.reasons, why)), why)

    def _resume(self, before: Manifest) -> None:
        """Continue an interrupted run.

        Raises:
            UsageError: the options, the system or its files differ from those of that run.
        """
        files = self._files
        if self._options.virtual:
            raise UsageError("--resume: not with --virtual: the same --seed gives the same run")
        if files is None:
            raise UsageError(f"--resume: {self._context.system.name} cannot be resumed; expected "
                             "layers.checkpoints, one host, and a judge that can resume")
        if why := differences(before, self._manifest):
            raise UsageError(f"--resume {files.directory}: {why}")
        begins_s, problem = files.recall(before.run_id, self._trial.recall)
        if problem:
            _say(problem)
        self._plan = msgspec.structs.replace(
            self._plan, run_id=before.run_id, part=before.part + 1,
            page=audited(self._plan.page, files.directory / f"audit-{before.run_id}.jsonl"),
            begins_s=begins_s + AFTER_S * self._plan.rate if begins_s else 0.0)
        self._manifest = msgspec.structs.replace(
            self._manifest, run_id=before.run_id, part=self._plan.part)
        self._context = replace(self._context, plan=self._plan)
        self._trial = self._made(self._plan, sys.stderr)
        files.recall(before.run_id, self._trial.recall)
        _say(f"run {before.run_id} is resumed at {self._plan.begins_s:.1f} s, part "
             f"{self._plan.part + 1}")

    def _made(self, plan: RunPlan, stream: TextIO | None) -> Trial:
        options, kind = self._options, self._kind
        return kind(replace(self._context, plan=plan),
                    options.patience if kind.patient else options.duration, stream)

    async def _on_processes(self, run: ProcessRun) -> int:
        with (_recorded(self._options) as recorder,
              _black_box(self._plan, self._trial.run.system, _say) as run.keep_alive):
            if recorder is not None:
                run.launcher.recording = lambda: (recorder.path, recorder.problem())
            record = await run.run()
        return self._conclude(record, run.failure,
                              recording=_recording(*run.launcher.recording()))

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
            raise TypeError("expected a console")
        console.banner(self._trial.about, self._plan, self._trial.run.system, virtual=True)
        try:
            with _interruptible(run):
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
                _say(f"{self._plan.error_log}: cannot write tracebacks: {in_words(error)}")
        return self._conclude(result.record, trace=result.trace, recording=_recording(
            self._options.record or "", recording.problem if recording else ""))

    def _conclude(self, record: RunRecord, failure: str = "", **more: Any) -> int:
        """Report the run and return the exit code, which no error of a disk or reader changes."""
        if self._files is not None and not failure:  # else it can be resumed
            with contextlib.suppress(ResumptionError, OSError):  # the report names a full disk
                self._files.end(msgspec.structs.replace(
                    self._manifest, ended=f"{record.mission or 'without a mission'}, "
                    f"{record.safety or 'without a judge'}"))
        report = self._trial.report(record, self._directory)
        if self._trial.console:
            self._trial.console.conclusion(record, report.html)
        if report.problem:
            _say(f"report: {report.problem}")
        for fault in record.faults:
            if not fault.effective:
                _say(f"fault {fault.fault} had no effect: {one_line(fault.reason)}")
        if self._options.json:
            more |= {"report": str(report.html) if report.html else None,
                     "record": str(report.data) if report.data else None,
                     "report_error": report.problem or None}
            print(json.dumps({"format": FORMAT, **self._trial.summary(record), **more}), flush=True)
            if why := streams.lost_result():
                _say(f"stdout: {why}: the result is lost")
        for node in dict.fromkeys((*record.given_up, *record.failing)):
            _say(f"{node} " + ("was given up" if node in record.given_up else
                               "fails again and again") +
                 f"; it was restarted {record.restarts.get(node, 0)} times")
        broken = bool(failure or record.given_up or record.failing)
        if not self._trial.judges:
            return EXIT_FAILED if broken else EXIT_SUCCESS
        if record.safety != "safe":
            return EXIT_UNSAFE if record.safety == "unsafe" else EXIT_NOT_KNOWN
        return EXIT_SUCCESS if record.mission == "success" and not broken else EXIT_FAILED


def _recording(file: str, problem: str) -> dict[str, str] | None:
    """Return the field `recording` of the result, None without a recording."""
    return {"file": file, "problem": problem} if file else None


def _say(text: str) -> None:
    print(f"{PROGRAM.get()}: " + " ".join(text.split()), file=sys.stderr, flush=True)


@contextlib.contextmanager
def _kept(directory: Path) -> Iterator[None]:
    """Provide the directory of a run; print whether it has tracebacks, and remove it if empty.

    Raises:
        UsageError: it cannot be created or written.
    """
    log = directory / ERROR_LOG
    made = not directory.exists()
    try:
        directory.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=directory).close()
    except OSError as error:
        raise UsageError(f"--report {directory}: expected a directory that can be written "
                         f"({error.strerror})") from None
    before = log.stat().st_size if log.exists() else 0
    try:
        yield
    finally:
        if log.exists() and log.stat().st_size > before:
            _say(f"tracebacks of failed processes: {log}")
        if made:
            with contextlib.suppress(OSError):  # not empty
                directory.rmdir()


@contextlib.contextmanager
def _recorded(options: argparse.Namespace) -> Iterator[RecorderProcess | None]:
    """Record the run in a separate process, with --record."""
    if not options.record:
        yield None
        return
    recorder = RecorderProcess(Order(
        options.port, str(Path(options.record).resolve()), os.getppid(), options.overwrite))
    recorder.start()
    try:
        yield recorder
    finally:
        recorder.end()


def black_box_folder(options: argparse.Namespace, spec: SystemSpec) -> str:
    """Return where the black box of a run writes; "" without one.

    Raises:
        UsageError: the option does not suit the run.
    """
    if options.black_box and spec.hosts:
        raise UsageError("--black-box: not on several hosts; use --record")
    if options.black_box is False or options.virtual or spec.hosts:
        return ""
    try:
        return str(state_folder(spec.name))
    except BagError as error:
        _say(f"black box: {error}")
        return ""


@contextlib.contextmanager
def _black_box(plan: RunPlan, spec: SystemSpec, say: Callable[[str], None]
               ) -> Iterator[Callable[[], None]]:
    """Start the black box; yield the function that keeps it alive, and reports its end once."""
    box = RecorderProcess(Order(
        plan.base_port, plan.black_box, os.getppid(), black_box=spec.black_box or BlackBox()))
    reported = ""

    def look(problem: Callable[[], str | None]) -> None:
        nonlocal reported
        try:
            found = problem()
        except OSError as error:
            found = f"cannot start: {in_words(error)}"
        if found and not reported:
            reported = found
            say(f"black box: {found}")

    if not plan.black_box:
        yield lambda: None
        return
    look(box.start)
    try:
        yield lambda: look(box.keep_alive)
    finally:
        box.end()
        look(box.problem)


@contextlib.contextmanager
def _interruptible(run: VirtualRun) -> Iterator[None]:
    """End a run on signals, the second time at once; ignored signals stay ignored."""

    def interrupt(number: int, _frame: object) -> None:
        if run.interrupted:
            raise KeyboardInterrupt
        run.interrupted = f"interrupted by {signal.Signals(number).name}"

    before = {number: signal.signal(number, interrupt)
              for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
              if signal.getsignal(number) is not signal.SIG_IGN}  # as SIGHUP is under nohup
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _in_child(run: Callable[[], Coroutine[Any, Any, int]]) -> int:
    """Watch a run in the root's child `run`, and return the exit code."""
    try:
        return asyncio.run(run())
    except (LaunchError, BagError, ValueError, OSError) as error:
        _say(str(error))
        return EXIT_USAGE


def _on_another_host(options: argparse.Namespace, plan: RunPlan, reports: Path) -> int:
    directory = Path(options.report) if options.report else (
        reports / f"{time.strftime('%Y%m%d-%H%M%S')}-{plan.host}")
    from rampart.cli.host import plan_of_host, take_part  # noqa: PLC0415 few runs have several hosts

    with _kept(directory):
        part, as_json = plan_of_host(options, plan, directory), options.json
        code = Root().run(lambda link: _in_child(lambda: take_part(part, link, as_json=as_json)))
        if code is None:
            _say("the process that watched this host was killed: its part of the run has ended")
            return EXIT_FAILED
        return code


def main(arguments: Sequence[str] | None = None, program: str = "launch.py",
         reports: Path = Path("reports")) -> int:
    """Parse the command line, run, and return the exit code.

    Args:
        arguments: arguments of the command line; None for those of this process.
        program: name of the command.
        reports: folder of reports without --report.
    """
    PROGRAM.set(program)
    streams.secure()
    working_folder.admit()  # for actors of one's own, as in the processes of a run
    resumed = None
    try:
        loading.begin()
        try:
            given = sys.argv[1:] if arguments is None else arguments
            which, lasting = of_one_process(given)
            resumed = find(reports, which) if which is not None else None
            if resumed is not None:
                files, before = resumed
                lasting = [*before.arguments, *lasting]
                given = [*before.arguments, *given, "--report", str(files.directory)]
            options, kind = parse(given, program)
            plan, spec = plan_of(options, kind, _say)
            run = None if plan.host else Run(options, plan, spec, reports, arguments=lasting,
                                             resumed=resumed)
        finally:
            loading.end()
        return run.run() if run else _on_another_host(options, plan, reports)
    except (LaunchError, BagError, ValueError, OSError) as error:
        _say(str(error))
        return EXIT_USAGE
    except KeyboardInterrupt:
        return EXIT_FAILED
    finally:
        if resumed is not None:
            resumed[0].unlock()


if __name__ == "__main__":
    sys.exit(main())
