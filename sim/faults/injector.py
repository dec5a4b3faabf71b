"""The injector: carries out the planned faults of a run, and watches whether they had an effect.

It lives beside the observer, outside the system under test. Faults of topics and actuators are
ordered over the bus and reported by those they hit; processes are hit through a `ProcessControl`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

from rampart.actors.bus import topics as bus_topics
from rampart.actors.bus.bounds import MANY
from rampart.actors.bus.limits import Remembered
from rampart.actors.bus.messages import InjectionReport
from rampart.actors.bus.topic import Topic
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.messages import (
    GroundTruth,
    MissionPhase,
    MissionStatus,
    ObstacleCommand,
    ObstacleList,
    Pose,
)
from rampart.actors.run.run_plan import SUPERVISOR
from rampart.actors.runtime.actor import Actor, Context, Header, on
from rampart.manager.spec.specification import Kind, SystemSpec
from rampart.sim.faults.scenario import (
    Action,
    FaultOutcome,
    OnActuators,
    OnProcess,
    OnTopics,
    OnWorld,
    PlannedFault,
    action_of,
)

INJECTOR = "injector"


class ProcessControl(Protocol):
    """Does things to processes; each method returns whether there was somebody to do it to."""

    def kill(self, node: str) -> bool:
        """SIGKILL."""

    def stop(self, node: str) -> bool:
        """SIGSTOP."""

    def resume(self, node: str) -> bool:
        """SIGCONT."""

    def wedge(self, node: str) -> bool:
        """Have its event loop turn no more."""

    def slow_down(self, node: str, pace_s: float) -> bool:
        """Have each message take so long; 0 ends that."""


def can_be_hit(spec: SystemSpec) -> tuple[str, ...]:
    """Return the nodes whose processes a fault may hit: all but the world, the supervisor too."""
    return (SUPERVISOR, *(node.name for node in spec.actors() if node.kind is not Kind.WORLD))


@dataclass(slots=True)
class _Planned:
    planned: PlannedFault
    action: Action
    ids: tuple[str, ...] = ()
    obstacle: str = ""
    injected_s: float | None = None
    affected: dict[str, int] = field(default_factory=lambda: Remembered(MANY))
    reason: str = ""

    def outcome(self) -> FaultOutcome:
        affected = sum(self.affected.values())
        reason = ""
        if self.injected_s is None:
            reason = "its moment never came"
        elif not affected:
            reason = self.reason or "it changed nothing"
        return FaultOutcome(self.planned.text(), self.injected_s, affected, reason)


class Injector(Actor):
    """Carries out a scenario of planned faults.

    Args:
        context: of the actor.
        scenario: what goes wrong, and when.
        processes: by which processes are hit.
        nodes: names that may be hit.
        known: all topics of the system.

    Raises:
        ScenarioError: a planned fault makes no sense in this system.
    """

    outputs = (bus_topics.INJECT, topics.ACTUATOR_FAULT, topics.OBSTACLE)

    def __init__(self, context: Context, scenario: Sequence[PlannedFault],
                 processes: ProcessControl, nodes: Sequence[str],
                 known: Sequence[Topic[Any]]) -> None:
        super().__init__(context)
        self._control = processes
        self._planned = [
            _Planned(planned, action_of(planned, f"f{i}", nodes, known))
            for i, planned in enumerate(scenario, start=1)]
        self._begun = 0
        self._pose: Pose | None = None

    def outcomes(self) -> tuple[FaultOutcome, ...]:
        """Return what became of the faults so far."""
        return tuple(fault.outcome() for fault in self._planned)

    def on_start(self) -> None:
        """Wait for the times that are known."""
        for fault in self._planned:
            if not fault.planned.goal:
                self._later(fault, fault.planned.at_s - self.clock.now())

    @on(topics.MISSION_STATUS)
    def mission(self, status: MissionStatus, _header: Header) -> None:
        """Note which goals have begun."""
        begun = status.step + 1 if status.phase is MissionPhase.RUNNING else 0
        while self._begun < begun:
            self._begun += 1
            for fault in self._planned:
                if fault.planned.goal == self._begun:
                    self._later(fault, fault.planned.at_s)

    @on(topics.TRUTH)
    def truth(self, truth: GroundTruth, _header: Header) -> None:
        """Note where the robot is."""
        self._pose = truth.pose

    @on(bus_topics.INJECTION_REPORT)
    def report(self, report: InjectionReport, header: Header) -> None:
        """Note what an injection has changed; a node that was restarted counts anew."""
        for fault in self._planned:
            if report.injection in fault.ids:
                slot = f"{report.injection} {header.source} {header.incarnation}"
                fault.affected[slot] = max(fault.affected.get(slot, 0), report.affected)
                fault.reason = fault.reason or report.reason

    @on(topics.OBSTACLES)
    def obstacles(self, listed: ObstacleList, _header: Header) -> None:
        """Note which obstacles are there."""
        names = {o.name for o in listed.obstacles if o.present}
        for fault in self._planned:
            if fault.obstacle in names:
                fault.affected["there"] = 1

    # -- acting ---------------------------------------------------------------------------------

    def _later(self, fault: _Planned, delay_s: float) -> None:
        self.call_later(max(delay_s, 0.0), lambda: self._inject(fault))

    def _inject(self, fault: _Planned) -> None:
        fault.injected_s = self.clock.now()
        action = fault.action
        if isinstance(action, OnTopics):
            fault.ids = tuple(order.injection for order in action.orders)
            for order in action.orders:
                self.publish(bus_topics.INJECT, order)
        elif isinstance(action, OnActuators):
            fault.ids = (action.order.injection,)
            self.publish(topics.ACTUATOR_FAULT, action.order)
        elif isinstance(action, OnProcess):
            self._hit(fault, action)
        else:
            self._place(fault, action)

    def _hit(self, fault: _Planned, action: OnProcess) -> None:
        node, control = action.node, self._control
        if action.what == "slow":
            hit = control.slow_down(node, action.pace_s)
        else:
            hit = {"kill": control.kill, "stop": control.stop,
                   "wedge": control.wedge}[action.what](node)
        if not hit:
            fault.reason = f"{node} had no running process"
            return
        fault.affected["hit"] = 1
        if action.what == "stop" and math.isfinite(action.duration_s):
            self.call_later(action.duration_s, lambda: self._end(control.resume(node)))
        elif action.what == "slow" and math.isfinite(action.duration_s):
            self.call_later(action.duration_s, lambda: self._end(control.slow_down(node, 0.0)))

    @staticmethod
    def _end(_done: bool) -> None:
        """Whether there still was somebody to release does not matter."""

    def _place(self, fault: _Planned, action: OnWorld) -> None:
        if self._pose is None:
            fault.reason = "nobody knows where the robot is"
            return
        pose = self._pose
        fault.obstacle = f"sudden-{self._planned.index(fault) + 1}"
        there = ObstacleCommand(
            fault.obstacle, True, pose.x_m + action.distance_m * math.cos(pose.yaw_rad),
            pose.y_m + action.distance_m * math.sin(pose.yaw_rad), action.radius_m)
        fault.reason = "there was no room for it"
        self.publish(topics.OBSTACLE, there)
        if math.isfinite(action.duration_s):
            gone = ObstacleCommand(there.name, False, there.x_m, there.y_m, there.radius_m)
            self.call_later(action.duration_s, lambda: self.publish(topics.OBSTACLE, gone))
