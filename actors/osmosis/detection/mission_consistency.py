"""DM11: the mission does not advance, or somebody in the control chain has got stuck.

A node may be alive and beat, and its timer repeat a message that is no longer true. Watchdogs do
not see that. This module hears what Mission Manager, Graph Planner and Osmosis Control hand on and
names the one that contradicts the others, so that it can be respawned.

The three hand a mission on: status and goal, route, progress. Each repeats what it says, so that
whoever contradicts the one before it for longer than a message takes is in error, and so is one
that falls silent although its process is well. What is said first in the chain is right: a planner
that follows a goal which is out of date is not to blame.

Two contradictions are with the world: progress that does not change while the robot drives, and an
arrival that is not reported although the robot stands at the goal.
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
    """How long is too long, and how far too far.

    Args:
        patience_s: how long a contradiction may last.
        silence_s: greatest age of what each node said last.
        arrival_s: how long the robot may stand at the goal without a word about it.
        arrival_m: how near to the goal that is.
        moved_m: how far the robot may drive while its progress is said to be the same.
    """

    patience_s: NonNegative = 2.5
    silence_s: NonNegative = 2.5
    arrival_s: NonNegative = 6.0
    arrival_m: NonNegative = 0.5
    moved_m: NonNegative = 3.0


@dataclass(slots=True)
class _Said:
    """What a node said last, when that was true, who it was, and which incarnation of it."""

    body: Any
    stamp_s: float
    source: str
    incarnation: int

    @property
    def name(self) -> str:
        """The node and its incarnation, `NAME#INCARNATION`: it is alive, so that one is meant."""
        return f"{self.source}#{self.incarnation}"


Contradiction = tuple[str, _Said, str, float]
"""What contradicts what (a name for it), whose word is wrong, why, how long it may last."""


class ConsistencyMonitor(Finding):
    """Active while a contradiction has lasted for too long.

    Args:
        limits: how long that is.
        start_s: now.
        known: whether idle may be claimed before anything was heard.
    """

    def __init__(self, limits: ConsistencyLimits, start_s: float, *, known: bool = True) -> None:
        super().__init__(-math.inf if known else start_s + limits.patience_s)
        self._limits = limits
        self._said: dict[str, _Said] = {}
        self._since_s: dict[str, float] = {}
        self._now_s = start_s
        self._odometer_m = 0.0
        self._pose: tuple[float, float] | None = None
        self._progress: tuple[tuple[str, int, float], float] = (("", 0, 0.0), 0.0)
        self._found: list[Contradiction] = []

    @property
    def due_s(self) -> float:
        """When time alone may change the finding."""
        now_s, silence_s = self._now_s, self._limits.silence_s
        due_s = [self._since_s[name] + lasts_s for name, _, _, lasts_s in self._found]
        due_s += [said.stamp_s + silence_s for said in self._said.values()]
        due_s.append(self._known_after_s)
        return min([t for t in due_s if t > now_s], default=math.inf)

    def expire(self, now_s: float) -> None:
        """Conclude from the time that has passed."""
        super().expire(now_s)
        self._now_s = now_s
        self._found = found = list(self._contradictions())
        self._since_s = {name: self._since_s.get(name, now_s) for name, *_ in found}
        for name, said, reason, lasts_s in found:
            if now_s >= self._since_s[name] + lasts_s - 1e-9:
                self.nodes, self.reason = (said.name,), f"{said.source}: {reason}"
                return
        self.clear()

    def heard(self, body: Any, source: str, incarnation: int, stamp_s: float, now_s: float) -> None:
        """Take note of a mission status, a goal, a route or a control status.

        Args:
            body: the message.
            source: who says it.
            incarnation: of the source; with a new one all its errors are forgiven.
            stamp_s: when it was true; one from the future, or that is no number, says that it
                is not updated.
            now_s: now.
        """
        kind = type(body).__name__
        before = self._said.get(kind)
        if before is not None and incarnation > before.incarnation:
            for other, said in list(self._said.items()):
                if said.source == source and said.incarnation < incarnation:
                    del self._said[other]  # what its former incarnation said is void
            self._since_s.clear()
        true_s = min(stamp_s, now_s) if is_possible(stamp_s, now_s) else -math.inf
        self._said[kind] = _Said(body, true_s, source, incarnation)
        if isinstance(body, m.ControlStatus):
            told = (body.mission_id, body.step, body.distance_to_go_m)
            if told != self._progress[0]:
                self._progress = (told, self._odometer_m)
        self.expire(now_s)

    def pose(self, x_m: float, y_m: float, now_s: float) -> None:
        """Take note of where the robot is, in `map`."""
        if not is_sane(x_m, y_m):
            return
        if self._pose is not None:
            self._odometer_m += math.dist(self._pose, (x_m, y_m))
        self._pose = (x_m, y_m)
        self.expire(now_s)

    def _contradictions(self) -> Iterator[Contradiction]:
        """Yield what contradicts now, the first in the chain first."""
        yield from self._silences()
        said = self._said
        status, goal = said.get("MissionStatus"), said.get("GoalOrder")
        route, control = said.get("Route"), said.get("ControlStatus")
        patience_s = self._limits.patience_s
        if status is None or goal is None:
            return
        if told := _goal_against_status(goal.body, status.body):
            yield "goal", goal, told, patience_s
        if route is None:
            return
        if told := _route_against_goal(route.body, goal.body):
            yield "route", route, told, patience_s
        if control is None or not route.body.active:
            return
        if _place(control.body) != _place(route.body):
            yield ("control", control, f"is at {_show(control.body)}, the route is for"
                   f" {_show(route.body)}", patience_s)
        elif status.body.phase in _DRIVING and _place(goal.body) == _place(route.body):
            yield from self._against_the_world(status, goal.body, control)

    def _silences(self) -> Iterator[Contradiction]:
        for kind, words in _WORDS.items():
            said = self._said.get(kind)
            if said is not None and self._now_s >= said.stamp_s + self._limits.silence_s - 1e-9:
                yield f"silent {kind}", said, f"its {words} is not updated", 0.0

    def _against_the_world(self, status: _Said, goal: m.GoalOrder, control: _Said
                           ) -> Iterator[Contradiction]:
        limits, said = self._limits, control.body
        if said.phase is m.ControlPhase.ARRIVED:
            yield ("arrival", status, f"goes on with {_show(goal)}, which is reached",
                   limits.patience_s)
        elif said.phase is m.ControlPhase.FOLLOWING:
            if self._odometer_m - self._progress[1] >= limits.moved_m:
                yield ("progress", control, "reports no progress, and the robot moves", 0.0)
            if self._pose is not None and math.dist(
                    self._pose, (goal.goal.x_m, goal.goal.y_m)) <= limits.arrival_m:
                yield ("standing", control, "reports no arrival, and the robot is there",
                       limits.arrival_s)


_WORDS = {"ControlStatus": "progress", "GoalOrder": "goal", "MissionStatus": "mission status",
          "Route": "route"}
"""In the order in which the silent are accused."""


def _place(said: Any) -> tuple[str, int]:
    return said.mission_id, said.step


def _show(said: Any) -> str:
    return f"goal {said.step + 1}" if said.mission_id else "no mission"


def _goal_against_status(goal: m.GoalOrder, status: m.MissionStatus) -> str:
    """Why a goal is not the one that the mission's status implies, or ""."""
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
    """Why a route is not for a goal, or ""."""
    if _place(route) != _place(goal):
        return f"plans to {_show(route)}, the order is {_show(goal)}"
    if route.active != goal.active:
        return f"{'plans' if route.active else 'does not plan'}, the goal says otherwise"
    if route.active and (route.plan != goal.plan or route.mode is not goal.goal.mode):
        return f"has not planned {_show(goal)} anew as ordered"
    return ""


class MissionConsistency(DetectionModule):
    """Active while a control node contradicts the others, or its words are not updated."""

    class Parameters(DetectionModule.Parameters, ConsistencyLimits, frozen=True):
        """As of `ConsistencyLimits`."""

    parameters: Parameters

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self.monitor = self.judged_by(ConsistencyMonitor(
            self.parameters, self.clock.now(), known=self.first_life))

    @on(topics.MISSION_STATUS)
    @on(topics.GOAL)
    @on(topics.ROUTE)
    @on(topics.CONTROL_STATUS)
    def hear(self, message: bm.Message, header: Header) -> None:
        """Hear how the mission stands, its goal, the route, or how far the robot is."""
        self.monitor.heard(message, header.source, header.incarnation, header.stamp,
                           self.clock.now())
        self.follow()

    @on(topics.POSE)
    def pose(self, message: m.Pose, _header: Header) -> None:
        """Hear where the robot is."""
        self.monitor.pose(message.x_m, message.y_m, self.clock.now())
        self.follow()
