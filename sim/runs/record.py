"""The record of a run, and the recorder that makes it from the messages. Pure."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sized
from types import MappingProxyType
from typing import Any, Literal

import msgspec

from rampart.actors.bus import messages as bm
from rampart.actors.bus import topics as bus_topics
from rampart.actors.bus.limits import Remembered
from rampart.actors.bus.topic import Topic
from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.ftm.keeping_up import KeptUp
from rampart.actors.ftm.narrator import Narrator
from rampart.actors.runtime.actor import Header
from rampart.actors.runtime.run_plan import RunPlan
from rampart.actors.web.audit import AuditLine
from rampart.manager.strategies.registry import decision_in_words
from rampart.sim.faults.scenario import FaultOutcome
from rampart.sim.runs.curves import Curve

KEPT = 10_000
"""Most events, intervals, decisions or names of a kind in a record."""

Mission = Literal["success", "fail"]
Safety = Literal["safe", "unsafe", "not known"]

_CRASHES = ("crashed", "stopped", "wedged", "given up")
_RECOVERED = ("respawned", "resumed", "adopted")
_ELSEWHERE = (fm.DecisionRecord, fm.ShadowRecord, bm.Diagnostic)
"""Decisions have a separate list, and error reports are in the log of the run."""


class Interval(msgspec.Struct, frozen=True):
    """A state that held from `from_s` to `to_s`, simulated seconds; `lane` is its kind.

    Lanes: injection, detection, recovery, stop, down (a node without a running process).
    """

    lane: str
    name: str
    from_s: float
    to_s: float
    reason: str = ""


class EventLine(msgspec.Struct, frozen=True):
    """One line of the log of faults; `kind` is fault or clear."""

    t_s: float
    kind: str
    text: str


class DecisionLine(msgspec.Struct, frozen=True):
    """A decision of the FTM Manager with its certificate, and in words.

    `detected_s` is the time of the first detection behind it. `shadow` is the choice of the shadow
    strategy where it differs.
    """

    t_s: float
    number: int
    strategy: str
    active: tuple[str, ...]
    block: int
    recoveries: tuple[str, ...]
    words: str
    path: tuple[str, ...]
    rejected: tuple[tuple[str, str], ...]
    detected_s: float
    shadow: str = ""


class RunRecord(msgspec.Struct, frozen=True, kw_only=True):
    """One run. Times are simulated seconds from its start.

    Args:
        run_id: Name of the run.
        mission: success or fail; None without a judge.
        safety: By ground truth; not known without any, None without a judge.
        reasons: Why the mission failed or the run was unsafe; empty if neither.
        duration_s: Length of the run.
        events: Crashes, detections and injections.
        intervals: The same as bars of a timeline.
        decisions: Decisions of the FTM Manager.
        restarts: Number of restarts by node; nodes without restarts are left out.
        given_up: Nodes that were no longer restarted at the end.
        failing: Nodes that failed repeatedly at the end; see `supervised_process.FAILING`.
        strategy: Name of the manager's strategy; "" without fault tolerance.
        seed: Seed of the run.
        rate: Simulated seconds per second.
        faults: Planned faults and their outcomes.
        keeping_up: Whether the machine kept up with the rate; None in virtual time.
        audit: Audit log of the operator's page.
        curves: Numbers of the robot; empty if its report draws others.
    """

    run_id: str
    mission: Mission | None = None
    safety: Safety | None = None
    reasons: tuple[str, ...] = ()
    duration_s: float
    events: tuple[EventLine, ...]
    intervals: tuple[Interval, ...]
    decisions: tuple[DecisionLine, ...]
    restarts: dict[str, int]
    given_up: tuple[str, ...] = ()
    failing: tuple[str, ...] = ()
    strategy: str
    seed: int
    rate: float
    faults: tuple[FaultOutcome, ...] = ()
    keeping_up: KeptUp | None = None
    audit: tuple[AuditLine, ...] = ()
    curves: tuple[Curve, ...] = ()


class RunRecorder:
    """Builds a `RunRecord` from the messages of a run.

    Args:
        plan: Plan of the run.
        strategy: Strategy of the manager; "" without fault tolerance.
        titles: Titles of mechanisms and recoveries, see `SystemSpec.titles`.
    """

    def __init__(self, plan: RunPlan, strategy: str = "",
                 titles: Mapping[str, str] = MappingProxyType({})) -> None:
        self._plan = plan
        self._strategy = strategy
        self._titles = titles
        self._narrator = Narrator(titles)
        self._left_out = 0
        self._events: list[EventLine] = []
        self._intervals: list[Interval] = []
        self._open: dict[tuple[str, str], tuple[float, str]] = {}
        self._decisions: Remembered[tuple[int, int], DecisionLine] = Remembered(KEPT)
        self._restarts: dict[str, int] = Remembered(KEPT)
        self._given_up: dict[str, None] = Remembered(KEPT)
        self._failing: dict[str, bool] = Remembered(KEPT)
        self._respawned: Remembered[tuple[str, int], None] = Remembered(KEPT)
        self._injections: dict[str, str] = Remembered(KEPT)
        self._lasts_s: dict[str, float] = Remembered(KEPT)
        self._disturbed: dict[str, str] = Remembered(KEPT)
        """The node that carries an injection out, by injection."""
        self._take: dict[str, Callable[[Any, Header], None]] = {
            ftm_topics.DETECTION.key: self._detection, ftm_topics.MANAGER_STATUS.key: self._manager,
            ftm_topics.DECISION.key: self._decision, ftm_topics.SHADOW.key: self._shadow,
            ftm_topics.PROCESS_EVENT.key: self._process_event, ftm_topics.NODES.key: self._nodes,
            bus_topics.INJECT.key: self._injection,
            bus_topics.INJECTION_REPORT.key: self._injection_report}

    def feed(self, topic: Topic[Any], message: Any, header: Header) -> None:
        """Record a message; messages of other topics are ignored."""
        take = self._take.get(topic.key)
        if take is not None:
            take(message, header)
        if not isinstance(message, _ELSEWHERE):
            for line in self._narrator.describe(message, header):
                self._note(header.stamp, line.level, line.text)

    def marks(self) -> int:
        """Return a number that grows with each event or decision."""
        return len(self._events) + len(self._decisions)

    def memory(self, now_s: float) -> bytes:
        """Return the record so far in the form that `recall` reads."""
        return msgspec.msgpack.encode(self.record(now_s))

    def recall(self, memory: bytes) -> RunRecord:
        """Continue the record of the part before, and return it.

        Raises:
            msgspec.DecodeError: The bytes are not a record.
        """
        record = msgspec.msgpack.decode(memory, type=RunRecord)
        self.continues(record)
        return record

    def continues(self, before: RunRecord) -> None:
        """Continue the record of the part before."""
        self._events = [*before.events, EventLine(
            before.duration_s, "fault", "the run was cut off; what it did until it was resumed "
            "was not watched")]
        self._intervals = list(before.intervals)
        for number, decision in enumerate(before.decisions):
            self._decisions[0, number] = decision  # incarnations of this part are above 0
        self._restarts.update(before.restarts)

    def record(self, duration_s: float, **more: Any) -> RunRecord:
        """Return the record so far; `more` are the other fields."""
        return RunRecord(**self.fields(duration_s), **more)

    def fields(self, duration_s: float) -> dict[str, Any]:
        """Return the fields of a record that come from messages."""
        still = [Interval(lane, name, from_s, max(from_s, min(
                     duration_s, from_s + (self._lasts_s.get(name, math.inf)
                                           if lane == "injection" else math.inf))), reason)
                 for (lane, name), (from_s, reason) in self._open.items()]
        events = sorted(self._events, key=lambda event: event.t_s)
        if count := self._left_out + self._decisions.forgotten:
            events.append(EventLine(duration_s, "fault", f"{count} more events, intervals, "
                                    "decisions or points of the way were not kept"))
        return {
            "run_id": self._plan.run_id, "seed": self._plan.seed, "rate": self._plan.rate,
            "strategy": self._strategy, "duration_s": duration_s, "events": tuple(events),
            "intervals": tuple(sorted((*self._intervals, *still), key=lambda bar: bar.from_s)),
            "decisions": tuple(self._decisions.values()), "restarts": dict(self._restarts),
            "given_up": tuple(self._given_up),
            "failing": tuple(name for name, failing in self._failing.items() if failing)}

    def _detection(self, report: fm.DetectionReport, header: Header) -> None:
        self.turn("detection", header.source, report.state is fm.DetectionState.ACTIVE,
                  header.stamp, report.reason)

    def _manager(self, status: fm.ManagerStatus, header: Header) -> None:
        for name in status.activated:
            self.turn("recovery", name, True, header.stamp)
        for lane, name in list(self._open):
            if lane == "recovery" and name not in status.activated:
                self.turn(lane, name, False, header.stamp)

    def _decision(self, record: fm.DecisionRecord, header: Header) -> None:
        r = record
        self._decisions[header.incarnation, r.decision] = DecisionLine(
            header.stamp, r.decision, r.strategy, r.active, r.rule, r.recoveries,
            decision_in_words(r.active, r.rule, r.recoveries, r.strategy, self._titles), r.path,
            r.rejected, r.detected_s)

    def _shadow(self, record: fm.ShadowRecord, header: Header) -> None:
        key = header.incarnation, record.decision
        if key in self._decisions:  # it is sent right after the decision
            self._decisions[key] = msgspec.structs.replace(
                self._decisions[key],
                shadow=f"{record.strategy}: {' and '.join(record.recoveries) or 'nothing'}")

    def _process_event(self, event: fm.ProcessEvent, header: Header) -> None:
        if not event.news:
            return
        if event.event in _CRASHES:
            self.turn("down", event.node, True, header.stamp, event.event)
        elif event.event in _RECOVERED:
            self.turn("down", event.node, False, header.stamp)
        if event.event == "given up":
            self._given_up[event.node] = None
        elif event.event in _RECOVERED:
            self._given_up.pop(event.node, None)
        if event.event == "respawned":
            one = event.node, event.incarnation
            if one not in self._respawned:
                self._respawned[one] = None
                self._restarts[event.node] = self._restarts.get(event.node, 0) + 1
                self._end_injections(event.node, header.stamp)

    def _nodes(self, table: fm.NodeTable, header: Header) -> None:
        """End intervals whose final event was lost with a router. The node table is repeated."""
        for row in table.nodes:
            self._failing[row.name] = row.failing
            down = self._open.get(("down", row.name))
            if down and row.state is fm.NodeState.RUNNING and header.stamp > down[0]:
                self.turn("down", row.name, False, header.stamp)
                self._given_up.pop(row.name, None)
                self._note(header.stamp, "clear", f"{row.name} runs again")

    def _injection(self, order: bm.Injection, _header: Header) -> None:
        self._injections[order.injection] = f"{order.mode} {order.topic}"
        if order.duration_s > 0:  # 0 ends it
            self._lasts_s[order.injection] = order.duration_s

    def _injection_report(self, report: bm.InjectionReport, header: Header) -> None:
        what = self._injections.get(report.injection, report.injection)
        self._disturbed[report.injection] = report.node
        self.turn("injection", report.injection, not report.finished, header.stamp, what)

    def _end_injections(self, node: str, t_s: float) -> None:
        """End what disturbs topics of a node: its next process does not."""
        for injection in self._injections:
            if self._disturbed.get(injection) == node:
                self.turn("injection", injection, False, t_s)

    # -- for recorders of a robot ---------------------------------------------------------------

    def turn(self, lane: str, name: str, on: bool, t_s: float, reason: str = "") -> bool:
        """Begin or end an interval; return whether that is a change."""
        slot = (lane, name)
        if on == (slot in self._open):
            return False
        if not on:
            from_s, why = self._open.pop(slot)
            if self.has_room(self._intervals, KEPT):
                self._intervals.append(Interval(lane, name, from_s, max(from_s, t_s), why))
        elif self.has_room(self._open, KEPT):
            self._open[slot] = (t_s, reason)
        return on == (slot in self._open)  # false if there was no room

    def _note(self, t_s: float, kind: str, text: str) -> None:
        if self.has_room(self._events, KEPT):
            self._events.append(EventLine(t_s, kind, text))

    def has_room(self, kept: Sized, most: int) -> bool:
        """Whether there is room for one more; it is counted if not."""
        if len(kept) < most:
            return True
        self._left_out += 1
        return False
