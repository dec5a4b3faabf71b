"""A trial: the part of a run outside of its processes, with observer, end and result.

A run makes a `Trial`. The trial makes the actors outside of the system, decides when the run is
over, and returns its record. `Trial` itself serves systems without a judge, for example those whose
world is not simulated here. A robot with its own verdict derives a class, which its application
names.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, ClassVar, TextIO

import msgspec

from rampart.actors.bus import topics as bus_topics
from rampart.actors.bus.topic import Topic
from rampart.actors.ftm import topics
from rampart.actors.ftm.keeping_up import KeepingUp
from rampart.actors.ftm.messages import NodeInfo, NodeState, NodeTable, ProcessEvent
from rampart.actors.runtime.actor import Actor, Context, Header
from rampart.actors.runtime.clock import Clock
from rampart.actors.runtime.parameters import read_parameters
from rampart.actors.runtime.run_context import RunContext
from rampart.actors.runtime.run_plan import OBSERVER, SUPERVISOR
from rampart.actors.system.members import (
    application_class,
    import_class,
    judge_class,
    judged_topics,
)
from rampart.actors.system.topics import system_topics
from rampart.actors.web.audit import read_audit
from rampart.manager.spec.schema import Kind, SystemSpec
from rampart.sim.faults.faults import faults_of
from rampart.sim.faults.injector import INJECTOR, Injector, ProcessControl
from rampart.sim.faults.scenario import FaultOutcome, PlannedFault
from rampart.sim.runs.console import Console
from rampart.sim.runs.curves import CurveRecorder
from rampart.sim.runs.judge import UNSTABLE, Judge, Verdict
from rampart.sim.runs.observer import Sink, observer_class
from rampart.sim.runs.record import RunRecord, RunRecorder, Safety
from rampart.sim.runs.report import Written, margin_text, render, try_report

LAUNCHER = "launch.py"
RECORDER = "recorder"

_DEAD_S = 0.4
"""Least time between two node tables with a dead world that end a judged run; simulated seconds. A
new supervisor may publish a table before it has adopted all living processes."""

_SAFETY: dict[bool | None, Safety] = {True: "safe", False: "unsafe", None: "not known"}


class Trial:
    """A run for a given time, without a judge.

    Class attributes:
        judges: Whether a run has a verdict.
        patient: Whether a run ends by itself or when it makes no progress; if not, after a time.
        injector: Class of the fault injector.
        tells: Class of the console.
        retunings: Named changes to a system, see `Job.retuned`.
        margins: Heading in reports of each margin, by name.
        margin_unit: Unit of all margins.
        exact_below: A margin from this value on may be a lower bound; None if all are exact.
        draws: Whether the report has curves of all numbers of the robot.
        resumes: Whether a resumed run continues the record of the part before.
        moments: First and last simulated time at which a campaign injects faults; None if they
            follow from the length of a run without faults.

    Args:
        run: Context of the run.
        limit_s: Length of the run, simulated seconds; None for the value in the specification. For
            a patient trial, longest time without progress.
        stream: Output of the console; None for none.

    Attributes:
        name: Name of the report's directory.
        title: Title of the run.
        about: Description of the run and its end, for the console.
        goals: Number of goals, for faults at the beginning of a goal.
        injects: The injector, if there are faults and `outside` was called.
    """

    judges: ClassVar[bool] = False
    patient: ClassVar[bool] = False
    injector: ClassVar[type[Injector]] = Injector
    tells: ClassVar[type[Console]] = Console
    retunings: ClassVar[Mapping[str, dict[str, dict[str, Any]]]] = {}
    margins: ClassVar[Mapping[str, str]] = {}
    margin_unit: ClassVar[str] = "m"
    exact_below: ClassVar[float | None] = None
    draws: ClassVar[bool] = True
    resumes: ClassVar[bool] = True
    moments: ClassVar[tuple[float, float] | None] = None

    def __init__(self, run: RunContext, limit_s: float | None = None,
                 stream: TextIO | None = None) -> None:
        self.run = run
        self.limit_s = run.system.end.after_s if limit_s is None else limit_s
        self.strategy = run.system.strategy if run.plan.ftm else ""
        self.name = run.system.name
        self.title = run.system.title
        self.about = f"{run.system.title} ({run.system.name}); ctrl-C ends it"
        self.goals = 0
        self.console = self.tells(stream) if stream else None
        self.recorder = RunRecorder(run.plan, self.strategy, run.system.titles)
        self.injects: Injector | None = None
        self._outcomes_before: tuple[FaultOutcome, ...] = ()
        self._brought_back = 0
        self._curves = CurveRecorder(system_topics(run.system) if self.draws else ())
        self._worlds = frozenset(n.name for n in run.system.nodes if n.kind is Kind.WORLD)
        # The process of a world is restarted only if a recovery module owns it.
        self._mortal = frozenset(
            nodes[0].name for nodes in run.system.processes().values()
            if self.judges and nodes[0].kind is Kind.WORLD and nodes[0].respawn == SUPERVISOR)
        self._dead_from_s: dict[str, float] = {}
        self._unjudged = ""
        self._keeping_up = None if run.plan.virtual else KeepingUp(
            run.system.timing, sorted(self._worlds), run.plan.rate, run.plan.begins_s)

    def sinks(self, clock: Clock) -> list[Sink]:
        """Return the receivers of the run's messages."""
        del clock
        return [self._look_at_world, self.recorder.feed, self._curves.take,
                *([self.console.take] if self.console else ())]

    def _look_at_world(self, topic: Topic[Any], message: Any, header: Header) -> None:
        if topic is bus_topics.DIAGNOSTIC and message.context == UNSTABLE \
                and header.source in self._worlds and not self._unjudged:
            self._unjudged = f"{UNSTABLE}: {message.reason}"
        elif topic is topics.NODES and self._mortal and not self._unjudged:
            for row in message.nodes:
                if row.name in self._mortal:
                    self._look_at_row(row, header.stamp)

    def _look_at_row(self, row: NodeInfo, now_s: float) -> None:
        if row.state is not NodeState.CRASHED:
            self._dead_from_s[row.name] = math.inf
        elif row.name in self._dead_from_s:  # else its first process is not forked yet
            from_s = self._dead_from_s[row.name] = min(self._dead_from_s[row.name], now_s)
            if now_s - from_s >= _DEAD_S:
                self._unjudged = (f"the world has died: nothing restarts {row.name}, and without "
                                  "it there is no ground truth")

    def outside(self, context: Callable[[str], Context], heard: Callable[[NodeTable], None],
                scenario: Sequence[PlannedFault], control: ProcessControl, nodes: Sequence[str],
                ) -> list[Actor]:
        """Return the actors outside of the system: its observer, and the injector of its faults.

        Args:
            context: Returns the context of an actor by its name.
            heard: Called with each node table of the supervisor.
            scenario: Faults and their times; without faults there is no injector.
            control: Kills and stops processes.
            nodes: Nodes that faults may hit.
        """
        def take(_topic: Topic[Any], message: Any, header: Header) -> None:
            if isinstance(message, NodeTable):
                heard(message)
                self._note_lateness(message, header.stamp)

        spec, observers = self.run.system, context(OBSERVER)
        kind = observer_class(spec)
        judged = self._curves.topics | {t.key: t for t in judged_topics(spec, kind)}
        observers = replace(observers, parameters={"judged": list(judged)}, topics=judged)
        actors: list[Actor] = [kind(observers, [take, *self.sinks(observers.clock)])]
        if scenario:
            self.injects = self.injector(
                context(INJECTOR), scenario, control, nodes=nodes, known=system_topics(spec),
                faults=faults_of(spec))
            actors.append(self.injects)
        return actors

    def _note_lateness(self, table: NodeTable, now_s: float) -> None:
        if self._keeping_up is not None:
            line = self._keeping_up.take(table, now_s)
            if line and self.console:
                self.console.line(now_s, line)

    def outcomes(self) -> tuple[FaultOutcome, ...]:
        """Return the outcomes of the faults so far."""
        return (*self._outcomes_before, *(self.injects.outcomes() if self.injects else ()))

    def memory(self, now_s: float) -> bytes:
        """Return the record so far in the form that `recall` reads."""
        return self.recorder.memory(now_s)

    def recall(self, memory: bytes) -> float:
        """Continue from the record of the part before; return its end, simulated seconds.

        Raises:
            msgspec.DecodeError: The bytes are not such a record.
        """
        before = self.recorder.recall(memory)
        self._outcomes_before = before.faults
        return before.duration_s

    def brought_back(self, name: str, now_s: float) -> None:
        """Note that the launcher restarted an actor."""
        self._brought_back += 1
        if self.console:
            self.console.line(now_s, f"{name} brought back")
        event = ProcessEvent(name, "respawned", 0, self._brought_back, LAUNCHER, "")
        self.recorder.feed(
            topics.PROCESS_EVENT, event, Header(LAUNCHER, 1, self._brought_back, now_s))

    def not_recorded(self, why: str, now_s: float) -> None:
        """Note that the recording ended before the run."""
        self.recorder.feed(topics.PROCESS_EVENT, ProcessEvent(RECORDER, "crashed", 0, 1, "", why),
                           Header(LAUNCHER, 1, 1, now_s))

    def excuse(self, stall_s: float) -> None:
        """Do not count simulated seconds in which the launcher was stopped."""

    def ended(self, now_s: float) -> str | None:
        """Return why the run is over, also if its world is unstable or dead, or None."""
        return self._unjudged or self.over(now_s)

    def settled(self, verdict: Verdict) -> Verdict:
        """Return a verdict that takes an unstable or dead world into account.

        After that, an unsafe run stays unsafe, and any other cannot be judged.
        """
        if not self._unjudged:
            return verdict
        return msgspec.structs.replace(
            verdict, success=False, safe=None if verdict.safe else verdict.safe,
            reasons=(self._unjudged, *verdict.reasons))

    def over(self, now_s: float) -> str | None:
        """Return why the run is over, or None while it continues."""
        is_over = self.limit_s is not None and now_s >= self.limit_s
        return "its time is over" if is_over else None

    def conclude(self, now_s: float, why: str) -> RunRecord:
        """Return the record of the run, with a verdict if there is one.

        Args:
            now_s: Simulated time.
            why: Why the run is over.
        """
        del why
        return self.recorder.record(now_s, **self._seen_to(now_s))

    def _seen_to(self, now_s: float) -> dict[str, Any]:
        """Return the fields of a record that do not come from messages."""
        log = self.run.plan.page.audit_log
        return {"faults": self.outcomes(), "audit": read_audit(Path(log)) if log else (),
                "curves": self._curves.curves(),
                "keeping_up": self._keeping_up.result(now_s) if self._keeping_up else None}

    def concluded(self, verdict: Verdict, now_s: float, why: str) -> RunRecord:
        """Return the record of a judged run that ended for a reason."""
        verdict, now_s = self.settled(verdict), max(0.0, now_s)
        ended = () if why == self._unjudged else (f"ended: {why}",)
        return self.recorder.record(
            now_s, **self._seen_to(now_s),
            mission="success" if verdict.success else "fail",
            safety=_SAFETY[verdict.safe],
            reasons=() if verdict.success and verdict.safe else (*verdict.reasons, *ended))

    def summary(self, record: RunRecord) -> dict[str, Any]:
        """Return the data of the last line of stdout with --json."""
        return {
            "mission": record.mission, "safety": record.safety, "reasons": record.reasons,
            "duration_s": round(record.duration_s, 2), "restarts": record.restarts,
            "given_up": record.given_up, "failing": record.failing,
            "keeping_up": msgspec.to_builtins(record.keeping_up),
            "decisions": msgspec.to_builtins(record.decisions),
            "faults": [{**msgspec.to_builtins(fault), "effective": fault.effective}
                       for fault in record.faults]}

    def judgement(self, record: RunRecord) -> Verdict:
        """Return the verdict on a run that is over."""
        return Verdict(success=record.mission == "success", safe=record.safety == "safe",
                       reasons=record.reasons)

    def report(self, record: RunRecord, directory: Path) -> Written:
        """Write the report, or as much of it as can be written."""
        return try_report(record, lambda run: render(run, self.title, self._margins(run)),
                          directory)

    def _margins(self, record: RunRecord) -> list[tuple[str, str]]:
        found = self.judgement(record).margins
        return [(label, margin_text(found.get(name), self.margin_unit, self.exact_below))
                for name, label in self.margins.items()]


class JudgedTrial(Trial):
    """A run with the judge that its specification names.

    Class attributes:
        judge: Class of the judge.
    """

    judges = True
    resumes = False
    judge: ClassVar[type[Judge]]

    def __init__(self, run: RunContext, limit_s: float | None = None,
                 stream: TextIO | None = None) -> None:
        super().__init__(run, limit_s, stream)
        given = {name: value for name, value in run.system.judge.items() if name != "class"}
        self._judge = self.judge(read_parameters(
            self.judge.Parameters, given, run.plan.system_file, "$.judge"))
        self._handlers = [(topic.key, getattr(self._judge, method))
                       for topic, method in self.judge._handlers]

    def sinks(self, clock: Clock) -> list[Sink]:
        """Return the receivers of the run's messages, the judge first."""

        def to_judge(topic: Topic[Any], message: Any, header: Header) -> None:
            for key, take in self._handlers:
                if key == topic.key:
                    take(message, header)

        return [to_judge, *super().sinks(clock)]

    def over(self, now_s: float) -> str | None:
        """Return the judge's reason why the run is over, or that its time is over, or None."""
        return self._judge.over(now_s) or super().over(now_s)

    def conclude(self, now_s: float, why: str) -> RunRecord:
        """Return the record of the run with the judge's verdict."""
        return self.concluded(self._judge.verdict(), now_s, why)

    def judgement(self, record: RunRecord) -> Verdict:
        """Return the judge's verdict."""
        del record
        return self.settled(self._judge.verdict())


def trial_class(spec: SystemSpec) -> type[Trial]:
    """Return the class of a system's trials, by its application or its judge.

    Raises:
        ValueError: The application, the judge, or a class of one of them does not exist, or the
            specification has a time limit for a mission.
    """
    path = application_class(spec).trial
    if path:
        found = import_class(path, Trial, "trial")
        if found.patient and spec.end.after_s is not None:
            raise ValueError(f"{spec.name}: $.end.after_s = {spec.end.after_s:g}: a mission ends "
                             "by itself; leave it out")
        return found
    return _judged_by(str(spec.judge.get("class"))) if judge_class(spec) else Trial


@cache
def _judged_by(path: str) -> type[Trial]:
    judge = import_class(path, Judge, "$.judge.class")
    return type(f"{judge.__name__}Trial", (JudgedTrial,), {
        "__doc__": judge.__doc__, "judge": judge, "margins": judge.margins,
        "margin_unit": judge.margin_unit, "exact_below": judge.exact_below})
