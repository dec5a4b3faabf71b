"""The injector: carries out the planned faults of a run, and watches whether they had an effect.

It runs beside the observer, outside the system under test. Faults of topics and actuators are
ordered over the bus and reported by those they hit; processes are hit through a `ProcessControl`. A
robot whose faults are more than that has an injector of its own, derived from this one.
"""

from __future__ import annotations

import asyncio
import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
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
from rampart.actors.runtime.timer import Timer
from rampart.manager.spec.schema import Kind, SystemSpec
from rampart.sim.faults.faults import Faults
from rampart.sim.faults.scenario import FaultOutcome, OnProcess, PlannedFault, action_of

INJECTOR = "injector"

SIGNALS = {"kill": "KILL", "stop": "STOP", "resume": "CONT", "wedge": "WEDGE"}
"""What is done to a process, as `kill-node` calls it; how slow one is, is up to the machine."""

_ENDS = {"stop": "resume", "slow": "slow", "hang": "resume"}
"""What ends that which is done to a process for a while."""

_HANGS_WITHIN_S = 0.02
"""Simulated seconds after its start within which a process that hangs each time is stopped."""


ProcessControl = Callable[[str, str, float], bool]
"""Does something to the process of a node, and tells whether there was one to do it to.

What is `kill`, `stop`, `resume` (SIGKILL, SIGSTOP, SIGCONT), `wedge` (its event loop turns no more)
or `slow` (each message takes so many seconds, the third argument; 0 ends that).
"""


Branch = Callable[[int], bool]
"""Asked, in the moment in which a scenario departs from others with the same beginning, whether
this is the run that goes on with it: the number of the scenario, counted from 0."""


def can_be_hit(spec: SystemSpec) -> tuple[str, ...]:
    """Return the nodes whose processes a fault may hit: all but the world, the supervisor too."""
    return (SUPERVISOR, *(node.name for node in spec.actors() if node.kind is not Kind.WORLD))


class PlannedAction(msgspec.Struct, eq=False):
    """A planned fault and what has become of it.

    Attributes:
        planned: what, and when.
        action: see `action_of`.
        watch: what is reported, if the action is a tuple of orders.
        scenario: number of the scenario that it is of.
        timer: until its moment.
        injected_s: simulated time, None until then.
        hit: 1 as soon as anything else was hit, a process for example.
        reason: why it has no effect, if it has none.
    """

    planned: PlannedFault
    action: object
    watch: FaultWatch
    scenario: int = 0
    timer: Timer | None = None
    injected_s: float | None = None
    hit: int = 0
    reason: str = ""

    def outcome(self) -> FaultOutcome:
        """Return what has become of it so far."""
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
        context: of the actor.
        scenario: what goes wrong, and when.
        processes: by which processes are hit.
        nodes: names that may be hit.
        known: all topics of the system.
        faults: of the robot.

    Raises:
        ScenarioError: a planned fault makes no sense in this system.

    Attributes:
        planned: all planned faults; none while it is open which of several scenarios this is.
        open: the scenarios that the run may still turn out to be, by number.
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
        self.open: dict[int, list[PlannedAction]] = {}
        self._branch: Branch | None = None
        self._begun = 0
        self._ordered: list[PlannedAction] = []
        self.planned = self._plan(scenario)

    def _plan(self, scenario: Sequence[PlannedFault], number: int = 0) -> list[PlannedAction]:
        planned = []
        times = Counter(fault.fault for fault in scenario)
        for i, fault in enumerate(scenario, start=1):
            name = fault.fault if times[fault.fault] == 1 else f"{fault.fault} ({i})"
            action = action_of(
                fault, clip(name, NAME_CHARS), self._nodes, self._known, self._faults)
            planned.append(PlannedAction(
                fault, action, FaultWatch(action if isinstance(action, tuple) else ()), number))
        self._may_publish.update(  # a robot orders its own faults on topics of its own
            order.topic.key for each in planned for order in each.watch.orders)
        return planned

    def outcomes(self) -> tuple[FaultOutcome, ...]:
        """Return what became of the faults so far."""
        return tuple(fault.outcome() for fault in self.planned)

    # -- one of several scenarios ---------------------------------------------------------------

    def one_of(self, scenarios: Sequence[Sequence[PlannedFault]], branch: Branch) -> None:
        """Leave open which of several scenarios this run is; to be called before it is started.

        In the moment of a scenario's first fault `branch` is asked. If it returns true, this is
        that scenario from then on, and has been from the beginning as far as a message can tell;
        if not, it is one of the others.

        Raises:
            ScenarioError: a planned fault makes no sense in this system.
        """
        self.open = {i: self._plan(scenario, i) for i, scenario in enumerate(scenarios)}
        self.planned = []
        self._branch = branch

    def decide(self, number: int) -> None:
        """Have it decided whether this run is a scenario, unless that is known."""
        if number not in self.open or self._branch is None:
            return
        faults = self.open.pop(number)
        others = faults
        if self._branch(number):
            others = list(self._awaited())
            self.planned = faults
            self.open.clear()
        for fault in others:
            if fault.timer is not None:
                fault.timer.cancel()

    def _awaited(self) -> Iterable[PlannedAction]:
        yield from self.planned
        for faults in self.open.values():
            yield from faults

    # -- when -----------------------------------------------------------------------------------

    def on_start(self) -> None:
        """Wait for the times that are known."""
        for fault in self._awaited():
            if not fault.planned.goal:
                self._later(fault, fault.planned.at_s - self.clock.now())

    def goals_begun(self, number: int) -> None:
        """Note that so many goals of the mission have begun; for the injector of a robot."""
        while self._begun < number:
            self._begun += 1
            for fault in self._awaited():
                if fault.planned.goal == self._begun:
                    self._later(fault, fault.planned.at_s)

    def carry_out(self, fault: PlannedAction) -> None:
        """Do what only the injector of a robot knows to do."""
        raise TypeError(f"{fault.action!r}: nothing that this injector can do")

    @on(bus_topics.INJECTION_REPORT)
    def report(self, report: InjectionReport, header: Header) -> None:
        """Note what an injection has changed; a node that was restarted counts anew."""
        for fault in self.planned:
            if fault.injected_s is not None:
                fault.watch.hear(report, header.incarnation)

    # -- acting ---------------------------------------------------------------------------------

    def _later(self, fault: PlannedAction, delay_s: float) -> None:
        delay_s = max(delay_s, 0.0)
        if self.open:  # decided first, and outside of the mailbox, whose items are counted
            asyncio.get_running_loop().call_at(
                self.clock.source_time(self.clock.now() + delay_s), self.decide, fault.scenario)
        fault.timer = self.call_later(delay_s, lambda: self._inject(fault))

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
        """Stop the process of a node of this host, and each that follows, until it is over."""
        if self.clock.now() < until_s:
            if self._control("stop", action.node, 0.0):
                fault.hit = 1
            elif not fault.hit:
                fault.reason = f"{action.node} had no running process here"
            self.call_later(_HANGS_WITHIN_S, lambda: self._hang(fault, action, until_s))

    def _do(self, what: str, fault: PlannedAction, action: OnProcess, pace_s: float) -> None:
        """Do something to one process, or to all; what runs on another host its supervisor hits."""
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
        """Note what the supervisor of another host has done to a process."""
        name, _, number = event.by.rpartition("-")
        if name == self.name and number.isdecimal() and 0 < int(number) <= len(self._ordered):
            fault = self._ordered[int(number) - 1]
            if event.event == "signalled":
                fault.hit = 1
            else:
                fault.reason = f"{event.node}: {event.detail}"
