"""The injector: carries out the planned faults of a run, and watches whether they had an effect.

It runs beside the observer, outside the system under test. Faults of topics and actuators are
ordered over the bus and reported by those they hit; processes are hit through a `ProcessControl`. A
robot whose faults are more than that has an injector of its own, derived from this one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import msgspec

from rampart.actors.bus import topics as bus_topics
from rampart.actors.bus.messages import InjectionReport
from rampart.actors.bus.topic import Topic
from rampart.actors.run.run_plan import SUPERVISOR
from rampart.actors.runtime.actor import Actor, Context, Header, on
from rampart.actors.runtime.fault_watch import FaultWatch
from rampart.manager.spec.schema import Kind, SystemSpec
from rampart.sim.faults.faults import Faults
from rampart.sim.faults.scenario import FaultOutcome, OnProcess, PlannedFault, action_of

INJECTOR = "injector"

_ENDS = {"stop": "resume", "slow": "slow"}
"""What ends that which is done to a process for a while."""


ProcessControl = Callable[[str, str, float], bool]
"""Does something to the process of a node, and tells whether there was one to do it to.

What is `kill`, `stop`, `resume` (SIGKILL, SIGSTOP, SIGCONT), `wedge` (its event loop turns no more)
or `slow` (each message takes so many seconds, the third argument; 0 ends that).
"""


def can_be_hit(spec: SystemSpec) -> tuple[str, ...]:
    """Return the nodes whose processes a fault may hit: all but the world, the supervisor too."""
    return (SUPERVISOR, *(node.name for node in spec.actors() if node.kind is not Kind.WORLD))


class PlannedAction(msgspec.Struct, eq=False):
    """A planned fault and what has become of it.

    Attributes:
        planned: what, and when.
        action: see `action_of`.
        watch: what is reported, if the action is a tuple of orders.
        injected_s: simulated time, None until then.
        hit: 1 as soon as anything else was hit, a process for example.
        reason: why it has no effect, if it has none.
    """

    planned: PlannedFault
    action: object
    watch: FaultWatch
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
        planned: all planned faults.
    """

    outputs: ClassVar[tuple[Topic[Any], ...]] = (bus_topics.INJECT,)

    def __init__(self, context: Context, scenario: Sequence[PlannedFault],
                 processes: ProcessControl, *, nodes: Sequence[str],
                 known: Sequence[Topic[Any]], faults: Faults) -> None:
        super().__init__(context)
        self._control = processes
        self.planned: list[PlannedAction] = []
        for i, planned in enumerate(scenario, start=1):
            action = action_of(planned, f"f{i}", nodes, known, faults)
            self.planned.append(PlannedAction(
                planned, action, FaultWatch(action if isinstance(action, tuple) else ())))
        self._may_publish.update(  # a robot orders its own faults on topics of its own
            order.topic.key for fault in self.planned for order in fault.watch.orders)
        self._begun = 0

    def outcomes(self) -> tuple[FaultOutcome, ...]:
        """Return what became of the faults so far."""
        return tuple(fault.outcome() for fault in self.planned)

    def on_start(self) -> None:
        """Wait for the times that are known."""
        for fault in self.planned:
            if not fault.planned.goal:
                self._later(fault, fault.planned.at_s - self.clock.now())

    def goals_begun(self, number: int) -> None:
        """Note that so many goals of the mission have begun; for the injector of a robot."""
        while self._begun < number:
            self._begun += 1
            for fault in self.planned:
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
        if not self._control(action.what, action.node, action.pace_s):
            fault.reason = f"{action.node} had no running process"
            return
        fault.hit = 1
        if action.what in _ENDS and math.isfinite(action.duration_s):
            self.call_later(action.duration_s, lambda: self._release(action))

    def _release(self, action: OnProcess) -> None:
        self._control(_ENDS[action.what], action.node, 0.0)
