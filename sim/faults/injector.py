"""The injector: carries out the planned faults of a run, and watches their effects.

It runs beside the observer, outside the system under test. It orders faults of topics and actuators
over the bus, and the affected nodes report them. It acts on processes through a `ProcessControl`. A
robot with further faults has a derived injector.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, ClassVar

import msgspec

from rampart.actors.bus import topics as bus_topics
from rampart.actors.bus.bounds import NAME_CHARS, clip
from rampart.actors.bus.messages import InjectionReport
from rampart.actors.bus.topic import Topic
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.ftm.messages import ProcessEvent, SignalOrder
from rampart.actors.runtime.actor import Actor, Context, Header, on
from rampart.actors.runtime.fault_watch import FaultWatch
from rampart.actors.runtime.run_plan import SUPERVISOR
from rampart.manager.spec.schema import Kind, SystemSpec
from rampart.sim.faults.faults import Faults
from rampart.sim.faults.scenario import FaultOutcome, OnProcess, PlannedFault, action_of

INJECTOR = "injector"

SIGNALS = {"kill": "KILL", "stop": "STOP", "resume": "CONT", "wedge": "WEDGE"}
"""Signals of `kill-node` by fault."""

_ENDS = {"stop": "resume", "slow": "slow", "hang": "resume"}
"""Action that ends a temporary fault of a process."""

_HANGS_WITHIN_S = 0.02
"""Time after its start within which a process that hangs each time is stopped; simulated s."""


ProcessControl = Callable[[str, str, float], bool]
"""Acts on the process of a node; returns False if there is none.

The action is `kill`, `stop`, `resume` (SIGKILL, SIGSTOP, SIGCONT), `wedge` (blocks its event loop)
or `slow` (each message takes the third argument, in seconds; 0 ends it).
"""


def can_be_hit(spec: SystemSpec) -> tuple[str, ...]:
    """Return the nodes whose processes a fault may hit: all but the world, and the supervisor."""
    return (SUPERVISOR, *(node.name for node in spec.actors() if node.kind is not Kind.WORLD))


class PlannedAction(msgspec.Struct, eq=False):
    """A planned fault and its effect.

    Attributes:
        planned: The fault.
        action: See `action_of`.
        watch: Reports, if the action is a tuple of orders.
        injected_s: Simulated time of its injection, None before.
        hit: 1 if it has affected something that does not report, such as a process.
        reason: Why it has no effect, if it has none.
    """

    planned: PlannedFault
    action: object
    watch: FaultWatch
    injected_s: float | None = None
    hit: int = 0
    reason: str = ""

    def outcome(self) -> FaultOutcome:
        """Return its effect so far."""
        affected = self.watch.affected + self.hit
        reason = ""
        if self.injected_s is None:
            reason = "its moment never came"
        elif not affected:
            reason = next(iter(self.watch.refused.values()), self.reason) or "it changed nothing"
        return FaultOutcome(self.planned.text(), self.injected_s, affected, reason)


class Injector(Actor):
    """Carries out a scenario of planned faults.

    Args:
        context: Of the actor.
        scenario: The planned faults.
        processes: Acts on processes.
        nodes: Nodes whose processes may be hit.
        known: All topics of the system.
        faults: Of the robot.

    Raises:
        ScenarioError: A planned fault is invalid in this system.

    Attributes:
        planned: All planned faults.
    """

    outputs: ClassVar[tuple[Topic[Any], ...]] = (bus_topics.INJECT, ftm_topics.SIGNAL)

    def __init__(self, context: Context, scenario: Sequence[PlannedFault],
                 processes: ProcessControl, *, nodes: Sequence[str],
                 known: Sequence[Topic[Any]], faults: Faults) -> None:
        event = ftm_topics.PROCESS_EVENT
        super().__init__(replace(context, topics={**context.topics, event.key: event}))
        if context.run.system.hosts:
            self.hear_topic(event.key, self._signalled)
        self._control = processes
        self._nodes, self._known, self._faults = nodes, known, faults
        self._begun = 0
        self._ordered: list[PlannedAction] = []
        self.planned = self._plan(scenario)

    def _plan(self, scenario: Sequence[PlannedFault]) -> list[PlannedAction]:
        planned = []
        times = Counter(fault.fault for fault in scenario)
        for i, fault in enumerate(scenario, start=1):
            name = fault.fault if times[fault.fault] == 1 else f"{fault.fault} ({i})"
            action = action_of(
                fault, clip(name, NAME_CHARS), self._nodes, self._known, self._faults)
            planned.append(PlannedAction(
                fault, action, FaultWatch(action if isinstance(action, tuple) else ())))
        self._may_publish.update(  # a robot has its own topics for faults
            order.topic.key for each in planned for order in each.watch.orders)
        return planned

    def outcomes(self) -> tuple[FaultOutcome, ...]:
        """Return the effects of the faults so far."""
        return tuple(fault.outcome() for fault in self.planned)

    # -- when -----------------------------------------------------------------------------------

    def on_start(self) -> None:
        """Wait for the known times."""
        for fault in self.planned:
            if not fault.planned.goal:
                self._later(fault, fault.planned.at_s - self.clock.now())

    def goals_begun(self, number: int) -> None:
        """Note the number of goals that have begun; called by the injector of a robot."""
        while self._begun < number:
            self._begun += 1
            for fault in self.planned:
                if fault.planned.goal == self._begun:
                    self._later(fault, fault.planned.at_s)

    def carry_out(self, fault: PlannedAction) -> None:
        """Carry out an action that only the injector of a robot knows."""
        raise TypeError(f"{fault.action!r}: this injector cannot carry it out")

    @on(bus_topics.INJECTION_REPORT)
    def report(self, report: InjectionReport, header: Header) -> None:
        """Note the effect of an injection; a restarted node counts from 0."""
        for fault in self.planned:
            if fault.injected_s is not None:
                fault.watch.hear(report, header.incarnation)

    # -- acting ---------------------------------------------------------------------------------

    def _later(self, fault: PlannedAction, delay_s: float) -> None:
        self.call_later(max(delay_s, 0.0), lambda: self._inject(fault))

    def _inject(self, fault: PlannedAction) -> None:
        fault.injected_s = self.clock.now()
        if isinstance(fault.action, OnProcess):
            self._hit(fault, fault.action)
        elif fault.watch.orders:
            for order in fault.watch.orders:
                self.publish(order.topic, order.message)
        else:
            self.carry_out(fault)

    def _hit(self, fault: PlannedAction, action: OnProcess) -> None:
        if action.what == "hang":
            self._hang(fault, action, self.clock.now() + action.duration_s)
        else:
            self._do(action.what, fault, action, action.pace_s)
        is_under_way = fault.hit or fault in self._ordered
        if is_under_way and action.what in _ENDS and math.isfinite(action.duration_s):
            self.call_later(action.duration_s,
                            lambda: self._do(_ENDS[action.what], fault, action, 0.0))

    def _hang(self, fault: PlannedAction, action: OnProcess, until_s: float) -> None:
        """Stop the process of a node of this host, and each later one, until the fault ends."""
        if self.clock.now() < until_s:
            if self._control("stop", action.node, 0.0):
                fault.hit = 1
            elif not fault.hit:
                fault.reason = f"{action.node} had no running process here"
            self.call_later(_HANGS_WITHIN_S, lambda: self._hang(fault, action, until_s))

    def _do(self, what: str, fault: PlannedAction, action: OnProcess, pace_s: float) -> None:
        """Act on one process, or on all; processes of another host through its supervisor."""
        for node in (action.node,) if action.node else self._nodes:
            if self._control(what, node, pace_s):
                fault.hit = 1
            elif self.context.run.system.hosts and what in SIGNALS:
                fault.reason = f"no host has answered that it runs {node}"
                self._ordered.append(fault)
                self.publish(ftm_topics.SIGNAL, SignalOrder(
                    f"{self.name}-{len(self._ordered)}", node, SIGNALS[what]))
            else:
                fault.reason = f"{node} had no running process"

    def _signalled(self, event: ProcessEvent, _header: Header) -> None:
        """Note the answer of the supervisor of another host."""
        name, _, number = event.by.rpartition("-")
        if name == self.name and number.isdecimal() and 0 < int(number) <= len(self._ordered):
            fault = self._ordered[int(number) - 1]
            if event.event == "signalled":
                fault.hit = 1
            else:
                fault.reason = f"{event.node}: {event.detail}"
