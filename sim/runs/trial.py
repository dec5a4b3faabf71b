"""What a run is besides its processes: who hears it, when it is over, and what comes of it.

A run of a system makes a `Trial`, has it make the actors that stand outside of the system, asks it
now and then whether the run is over, and has it conclude. This one is for systems without a judge:
those that are being specified, and those whose world is not simulated here. A robot whose runs end
with a verdict derives its own, which its application names.
"""

from __future__ import annotations

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
from rampart.actors.ftm.messages import NodeTable, ProcessEvent
from rampart.actors.runtime.actor import Actor, Context, Header
from rampart.actors.runtime.clock import Clock
from rampart.actors.runtime.parameters import read_parameters
from rampart.actors.runtime.run_context import RunContext
from rampart.actors.runtime.run_plan import OBSERVER
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

_SAFETY: dict[bool | None, Safety] = {True: "safe", False: "unsafe", None: "not known"}


class Trial:
    """A run that goes on for a while, without a judge.

    Class attributes:
        judges: whether there is a verdict on it.
        patient: whether it ends by itself, or when nothing progresses; else after a while.
        injector: who carries out faults.
        tells: who tells the story.
        retunings: changes to a system that have a name, see `Job.retuned`.
        margins: how far from harm a run was: names, and how they are headed in a report.
        margin_unit: of all of them.
        exact_below: above it a margin may be a lower bound; None if all are exact.
        draws: whether its report has curves of all the robot's numbers.
        resumes: whether what was seen in one part of a run is known in the next.
        pictures: class path of the `RunPictures` that a campaign's report shows; "" for none.

    Args:
        run: what is run.
        limit_s: simulated seconds after which it is over, None for those of the specification;
            for one that is patient, seconds without progress.
        stream: for the story; None keeps quiet.

    Attributes:
        name: of the directory in which its report goes.
        title: of the run, for people.
        about: what is about to run, and how it ends.
        goals: how many there are, for faults at the beginning of one.
        injects: the injector of its faults, if there are any, from `outside` on.
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
    pictures: ClassVar[str] = ""

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
        self._unjudged = ""
        self._keeping_up = None if run.plan.virtual else KeepingUp(
            run.system.timing, sorted(self._worlds), run.plan.rate, run.plan.begins_s)

    def sinks(self, clock: Clock) -> list[Sink]:
        """Return what wants to hear the run's messages."""
        del clock
        return [self._look_at_world, self.recorder.feed, self._curves.take,
                *([self.console.take] if self.console else ())]

    def _look_at_world(self, topic: Topic[Any], message: Any, header: Header) -> None:
        if topic is bus_topics.DIAGNOSTIC and message.context == UNSTABLE \
                and header.source in self._worlds and not self._unjudged:
            self._unjudged = f"{UNSTABLE}: {message.reason}"

    def outside(self, context: Callable[[str], Context], heard: Callable[[NodeTable], None],
                scenario: Sequence[PlannedFault], control: ProcessControl, nodes: Sequence[str],
                ) -> list[Actor]:
        """Return the actors outside of the system: its observer, and the injector of its faults.

        Args:
            context: returns that of an actor, by its name.
            heard: is told what the supervisor says of the nodes.
            scenario: what goes wrong, and when; without it there is no injector.
            control: by which processes are hit.
            nodes: names that may be hit.
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
        """Return what has become of the faults so far."""
        return (*self._outcomes_before, *(self.injects.outcomes() if self.injects else ()))

    def memory(self, now_s: float) -> bytes:
        """Return what a resumed run needs of what was seen so far."""
        return self.recorder.memory(now_s)

    def recall(self, memory: bytes) -> float:
        """Go on from the memory of the part before, and return when it was kept, simulated s.

        Raises:
            msgspec.DecodeError: the bytes are not a memory.
        """
        before = self.recorder.recall(memory)
        self._outcomes_before = before.faults
        return before.duration_s

    def brought_back(self, name: str, now_s: float) -> None:
        """Note that the launcher has brought an actor back."""
        self._brought_back += 1
        if self.console:
            self.console.line(now_s, f"{name} brought back")
        event = ProcessEvent(name, "respawned", 0, self._brought_back, LAUNCHER, "")
        self.recorder.feed(
            topics.PROCESS_EVENT, event, Header(LAUNCHER, 1, self._brought_back, now_s))

    def not_recorded(self, why: str, now_s: float) -> None:
        """Note that the recording of the run has ended before it."""
        self.recorder.feed(topics.PROCESS_EVENT, ProcessEvent(RECORDER, "crashed", 0, 1, "", why),
                           Header(LAUNCHER, 1, 1, now_s))

    def excuse(self, stall_s: float) -> None:
        """Do not count simulated seconds in which the launcher heard nothing, being stopped."""

    def ended(self, now_s: float) -> str | None:
        """Return why the run is over, or None: also because its world has blown up."""
        return self._unjudged or self.over(now_s)

    def settled(self, verdict: Verdict) -> Verdict:
        """Return a verdict on the run, of which the end was not watched if the world was lost.

        An unsafe run stays unsafe; any other cannot be judged.
        """
        if not self._unjudged:
            return verdict
        return msgspec.structs.replace(
            verdict, success=False, safe=None if verdict.safe else verdict.safe,
            reasons=(self._unjudged, *verdict.reasons))

    def over(self, now_s: float) -> str | None:
        """Return why the run is over, or None while it goes on."""
        is_over = self.limit_s is not None and now_s >= self.limit_s
        return "its time is over" if is_over else None

    def conclude(self, now_s: float, why: str) -> RunRecord:
        """Return the record of the run, with a verdict if there is one.

        Args:
            now_s: simulated time.
            why: it is over.
        """
        del why
        return self.recorder.record(now_s, **self._seen_to(now_s))

    def _seen_to(self, now_s: float) -> dict[str, Any]:
        """Return the fields of a record that come from elsewhere than messages."""
        log = self.run.plan.page.audit_log
        return {"faults": self.outcomes(), "audit": read_audit(Path(log)) if log else (),
                "curves": self._curves.curves(),
                "keeping_up": self._keeping_up.result(now_s) if self._keeping_up else None}

    def concluded(self, verdict: Verdict, now_s: float, why: str) -> RunRecord:
        """Return the record of a run that has ended for a reason, and was judged."""
        verdict = self.settled(verdict)
        return self.recorder.record(
            now_s, **self._seen_to(now_s),
            mission="success" if verdict.success else "fail",
            safety=_SAFETY[verdict.safe],
            reasons=() if verdict.success and verdict.safe else (*verdict.reasons, f"ended: {why}"))

    def summary(self, record: RunRecord) -> dict[str, Any]:
        """Return what scripts rely on: the last line of stdout with --json."""
        return {
            "mission": record.mission, "safety": record.safety, "reasons": record.reasons,
            "duration_s": round(record.duration_s, 2), "restarts": record.restarts,
            "given_up": record.given_up, "failing": record.failing,
            "keeping_up": msgspec.to_builtins(record.keeping_up),
            "decisions": msgspec.to_builtins(record.decisions),
            "faults": [{**msgspec.to_builtins(fault), "effective": fault.effective}
                       for fault in record.faults]}

    def judgement(self, record: RunRecord) -> Verdict:
        """Return what only a judge knows of a run that is over."""
        return Verdict(success=record.mission == "success", safe=record.safety == "safe",
                       reasons=record.reasons)

    @classmethod
    def moments(cls, spec: SystemSpec, *, searched: bool = False) -> tuple[float, float] | None:
        """Return between which simulated times a campaign injects faults, or a search does.

        None: that follows from how long a run without a fault takes.
        """
        del spec, searched
        return None

    def report(self, record: RunRecord, directory: Path) -> Written:
        """Write as much of a report as can be written."""
        return try_report(record, lambda run: render(run, self.title, self._margins(run)),
                          directory)

    def _margins(self, record: RunRecord) -> list[tuple[str, str]]:
        found = self.judgement(record).margins
        return [(label, margin_text(found.get(name), self.margin_unit, self.exact_below))
                for name, label in self.margins.items()]


class JudgedTrial(Trial):
    """A run that a judge hears, which the system's specification names.

    Class attributes:
        judge: class of the judge.
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
        self._hears = [(topic.key, getattr(self._judge, method))
                       for topic, method in self.judge._handlers]

    def sinks(self, clock: Clock) -> list[Sink]:
        """Return what wants to hear the run's messages: the judge first."""

        def to_judge(topic: Topic[Any], message: Any, header: Header) -> None:
            for key, hear in self._hears:
                if key == topic.key:
                    hear(message, header)

        return [to_judge, *super().sinks(clock)]

    def over(self, now_s: float) -> str | None:
        """Return why the run is over: what the judge says, or that its time is over."""
        return self._judge.over(now_s) or super().over(now_s)

    def conclude(self, now_s: float, why: str) -> RunRecord:
        """Return the record of the run with the judge's verdict, and what became of faults."""
        return self.concluded(self._judge.verdict(), now_s, why)

    def judgement(self, record: RunRecord) -> Verdict:
        """Return the judge's verdict."""
        del record
        return self.settled(self._judge.verdict())


def trial_class(spec: SystemSpec) -> type[Trial]:
    """Return what a run of a system is: that of its application, or one that its judge hears.

    Raises:
        ValueError: the application, the judge, or a class that one of them names does not exist,
            or the specification says when a mission ends.
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
