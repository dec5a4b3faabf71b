"""DM11: the control chain is inconsistent, or the mission does not advance.

A node may send heartbeats while its timer repeats an outdated message, which watchdogs do not
detect. This module compares the outputs of Mission Manager, Graph Planner and Osmosis Control, and
names the node that contradicts the others, so that it can be restarted.

The chain is: status and goal, route, progress. Each node repeats its output. So a node is wrong if
it contradicts its predecessor for longer than a message takes, or if it is silent although its
process is alive. The first output in the chain is the reference: a planner that follows an outdated
goal is not named.

Two contradictions are with the world: progress that is constant while the robot drives, and an
arrival that is not reported while the robot stands at the goal.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import msgspec

from rampart.actors.bus import messages as bm
from rampart.actors.detection.finding import Finding
from rampart.actors.detection.module import DetectionModule
from rampart.actors.ftm.plausible import is_possible, is_sane
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.runtime.actor import Context, Header, on
from rampart.manager.spec.tables import NonNegative

_DRIVING = frozenset({m.MissionPhase.RUNNING, m.MissionPhase.RETURNING})


class ConsistencyLimits(msgspec.Struct, frozen=True):
    """Tolerances.

    Args:
        patience_s: longest contradiction.
        silence_s: greatest age of each node's last output.
        arrival_s: longest stay at the goal without a reported arrival.
        arrival_m: distance to the goal that counts as a stay.
        moved_m: longest distance driven at constant reported progress.
    """

    patience_s: NonNegative = 2.5
    silence_s: NonNegative = 2.5
    arrival_s: NonNegative = 6.0
    arrival_m: NonNegative = 0.5
    moved_m: NonNegative = 3.0


@dataclass(slots=True)
class _Output:
    """Last message of a node, its time and its sender."""

    body: Any
    stamp_s: float
    source: str
    incarnation: int

    @property
    def name(self) -> str:
        """The node with its incarnation: `NAME#INCARNATION`."""
        return f"{self.source}#{self.incarnation}"


Contradiction = tuple[str, _Output, str, float]
"""Name of the contradiction, wrong output, reason, longest duration."""


class ConsistencyMonitor(Finding):
    """Active while a contradiction has lasted too long.

    Args:
        limits: tolerances.
        start_s: now.
        known: whether it may be idle before any input.
    """

    def __init__(self, limits: ConsistencyLimits, start_s: float, *, known: bool = True) -> None:
        super().__init__(-math.inf if known else start_s + limits.patience_s)
        self._limits = limits
        self._outputs: dict[str, _Output] = {}
        self._since_s: dict[str, float] = {}
        self._now_s = start_s
        self._odometer_m = 0.0
        self._pose: tuple[float, float] | None = None
        self._progress: tuple[tuple[str, int, float], float] = (("", 0, 0.0), 0.0)
        self._found: list[Contradiction] = []

    @property
    def due_s(self) -> float:
        """Time of the next possible change without input."""
        now_s, silence_s = self._now_s, self._limits.silence_s
        due_s = [self._since_s[name] + lasts_s for name, _, _, lasts_s in self._found]
        due_s += [output.stamp_s + silence_s for output in self._outputs.values()]
        due_s.append(self._known_after_s)
        return min([t for t in due_s if t > now_s], default=math.inf)

    def expire(self, now_s: float) -> None:
        """Update the finding by time."""
        super().expire(now_s)
        self._now_s = now_s
        self._found = found = list(self._contradictions())
        self._since_s = {name: self._since_s.get(name, now_s) for name, *_ in found}
        if not found and self._outputs.keys() == _SUBJECTS.keys():
            self.known = True  # a respawned module has seen the whole chain, and it is consistent
        for name, output, reason, lasts_s in found:
            if now_s >= self._since_s[name] + lasts_s - 1e-9:
                self.nodes, self.reason = (output.name,), f"{output.source}: {reason}"
                return
        self.clear()

    def take(self, body: Any, source: str, incarnation: int, stamp_s: float, now_s: float) -> None:
        """Take a mission status, a goal, a route or a control status.

        Args:
            body: the message.
            source: its sender.
            incarnation: incarnation of the sender; a new one clears its contradictions.
            stamp_s: its time; an invalid one or one in the future counts as not updated.
            now_s: now.
        """
        kind = type(body).__name__
        before = self._outputs.get(kind)
        if before is not None and incarnation > before.incarnation:
            for other, output in list(self._outputs.items()):
                if output.source == source and output.incarnation < incarnation:
                    del self._outputs[other]  # output of the previous incarnation
            self._since_s.clear()
        true_s = min(stamp_s, now_s) if is_possible(stamp_s, now_s) else -math.inf
        self._outputs[kind] = _Output(body, true_s, source, incarnation)
        if isinstance(body, m.ControlStatus):
            progress = (body.mission_id, body.step, body.distance_to_go_m)
            if progress != self._progress[0]:
                self._progress = (progress, self._odometer_m)
        self.expire(now_s)

    def pose(self, x_m: float, y_m: float, now_s: float) -> None:
        """Take the position of the robot in `map`."""
        if not is_sane(x_m, y_m):
            return
        if self._pose is not None:
            self._odometer_m += math.dist(self._pose, (x_m, y_m))
        self._pose = (x_m, y_m)
        self.expire(now_s)

    def _contradictions(self) -> Iterator[Contradiction]:
        """Yield the present contradictions in the order of the chain."""
        yield from self._silences()
        get = self._outputs.get
        status, goal = get("MissionStatus"), get("GoalOrder")
        route, control = get("Route"), get("ControlStatus")
        patience_s = self._limits.patience_s
        if status is None or goal is None:
            return
        if reason := _goal_against_status(goal.body, status.body):
            yield "goal", goal, reason, patience_s
        if route is None:
            return
        if reason := _route_against_goal(route.body, goal.body):
            yield "route", route, reason, patience_s
        if control is None or not route.body.active:
            return
        if _place(control.body) != _place(route.body):
            yield ("control", control, f"is at {_show(control.body)}, the route is for"
                   f" {_show(route.body)}", patience_s)
        elif status.body.phase in _DRIVING and _place(goal.body) == _place(route.body):
            yield from self._against_the_world(status, goal.body, control)

    def _silences(self) -> Iterator[Contradiction]:
        for kind, subject in _SUBJECTS.items():
            output = self._outputs.get(kind)
            if output is not None and self._now_s >= output.stamp_s + self._limits.silence_s - 1e-9:
                yield f"silent {kind}", output, f"its {subject} is not updated", 0.0

    def _against_the_world(self, status: _Output, goal: m.GoalOrder, control: _Output
                           ) -> Iterator[Contradiction]:
        limits, report = self._limits, control.body
        if report.phase is m.ControlPhase.ARRIVED:
            yield ("arrival", status, f"keeps {_show(goal)}, which is reached",
                   limits.patience_s)
        elif report.phase is m.ControlPhase.FOLLOWING:
            if self._odometer_m - self._progress[1] >= limits.moved_m:
                yield ("progress", control, "reports no progress while the robot moves", 0.0)
            if self._pose is not None and math.dist(
                    self._pose, (goal.goal.x_m, goal.goal.y_m)) <= limits.arrival_m:
                yield ("standing", control, "reports no arrival while the robot is at the goal",
                       limits.arrival_s)


_SUBJECTS = {"ControlStatus": "progress", "GoalOrder": "goal", "MissionStatus": "mission status",
          "Route": "route"}
"""In the order in which silent nodes are named."""


def _place(body: Any) -> tuple[str, int]:
    return body.mission_id, body.step


def _show(body: Any) -> str:
    return f"goal {body.step + 1}" if body.mission_id else "no mission"


def _goal_against_status(goal: m.GoalOrder, status: m.MissionStatus) -> str:
    """Return how a goal contradicts the mission's status, or ""."""
    driving = status.phase in _DRIVING
    if goal.mission_id != status.mission_id or goal.active != driving:
        return (f"gives {'a' if goal.active else 'no'} goal of mission {goal.mission_id or '-'},"
                f" mission {status.mission_id or '-'} is {status.phase.value}")
    if status.phase is not m.MissionPhase.RUNNING:
        return ""
    if goal.step != status.step or status.step >= len(status.goals):
        return f"gives goal {goal.step + 1}, the mission is at goal {status.step + 1}"
    if goal.goal != status.goals[status.step]:
        return f"gives goal {goal.step + 1} as another point than the mission has"
    return ""


def _route_against_goal(route: m.Route, goal: m.GoalOrder) -> str:
    """Return how a route contradicts the goal, or ""."""
    if _place(route) != _place(goal):
        return f"plans to {_show(route)}, the order is {_show(goal)}"
    if route.active != goal.active:
        return f"{'plans' if route.active else 'does not plan'} against the goal"
    if route.active and (route.plan != goal.plan or route.mode is not goal.goal.mode):
        return f"has not replanned {_show(goal)} as ordered"
    return ""


class MissionConsistency(DetectionModule):
    """Active while a control node contradicts the others or does not update its output."""

    class Parameters(DetectionModule.Parameters, ConsistencyLimits, frozen=True):
        """Those of `ConsistencyLimits`."""

    parameters: Parameters

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self.monitor = self.judged_by(ConsistencyMonitor(
            self.parameters, self.clock.now(), known=self.first_life))

    @on(topics.MISSION_STATUS)
    @on(topics.GOAL)
    @on(topics.ROUTE)
    @on(topics.CONTROL_STATUS)
    def output(self, message: bm.Message, header: Header) -> None:
        """Take an output of the control chain."""
        self.monitor.take(message, header.source, header.incarnation, header.stamp,
                          self.clock.now())
        self.follow()

    @on(topics.POSE)
    def pose(self, message: m.Pose, _header: Header) -> None:
        """Take the position of the robot."""
        self.monitor.pose(message.x_m, message.y_m, self.clock.now())
        self.follow()
