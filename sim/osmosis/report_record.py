"""What is kept of a run, and the recorder that collects it from the messages. Pure."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, Literal

import msgspec

from rampart.actors.bus import messages as bm
from rampart.actors.bus import topics as bus_topics
from rampart.actors.bus.limits import Remembered
from rampart.actors.bus.topic import Topic
from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.airport.drawing import AirportDrawing, draw
from rampart.actors.osmosis.airport.model import Airport, Mission
from rampart.actors.runtime.actor import Header
from rampart.manager.strategies.decision_words import decision_in_words
from rampart.sim.faults.scenario import FaultOutcome

TRACK_STEP_M = 0.2
"""A track point is kept when the robot has moved this far."""

KEPT = 10_000
"""Most events, intervals, decisions or names of a kind that are kept of a run."""

TRACK_KEPT = 100_000
"""Most points of a track: twenty kilometres and more."""

Safety = Literal["safe", "unsafe", "not known"]

_CRASHES = ("crashed", "stopped", "wedged", "given up")
_RECOVERED = ("respawned", "resumed", "adopted")


class LightResult(msgspec.Struct, frozen=True):
    """A light of the airport; `verdict` is ok, dim, out or not measured (then without values)."""

    name: str
    row: str
    x_m: float
    y_m: float
    nominal_cd: float
    verdict: str = "not measured"
    intensity_cd: float | None = None
    ratio: float | None = None


class StepResult(msgspec.Struct, frozen=True):
    """A goal of the mission and when it was reached, simulated seconds, or None."""

    mode: str
    x_m: float
    y_m: float
    reached_s: float | None


class Interval(msgspec.Struct, frozen=True):
    """Something was so from `from_s` until `to_s` (simulated seconds): `lane` says what kind.

    Lanes: injection, detection, recovery, stop, down (a node without a living process).
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

    `detected_s` is when the first detection behind it was made; `shadow` is what the strategy in
    shadow would have run instead, where it differs.
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


class ObstacleSeen(msgspec.Struct, frozen=True):
    """An obstacle that was there at some time."""

    name: str
    x_m: float
    y_m: float
    radius_m: float


class RunRecord(msgspec.Struct, frozen=True, kw_only=True):
    """One run. Times are simulated seconds from its start, positions are in `map`.

    Args:
        run_id: name of the run.
        airport: its geometry.
        mission_name: of the mission.
        mission: success or fail (paper, section V: every point in order and in its mode).
        safety: safe or unsafe, by ground truth; not known if none ever came.
        reasons: why the mission failed or the run was not safe; empty if all is well.
        duration_s: length of the run.
        distance_m: length of the way really driven.
        track: (t, x, y) of the way really driven.
        believed: (t, x, y) of the way that localization reported.
        lights: all lights of the airport.
        steps: all goals of the mission.
        obstacles: that stood there at some time.
        events: crashes, detections and injections.
        intervals: the same as bars for a timeline.
        decisions: of the FTM Manager.
        restarts: node name to number of restarts; nodes never restarted are left out.
        collisions: counted by ground truth.
        prohibited_s: time spent in the prohibited area.
        obstacle_clearance_m: closest approach to an obstacle, None if there was none.
        prohibited_clearance_m: closest approach to the prohibited area, negative inside.
        strategy: name of the manager's strategy, empty without FTMs.
        seed: of everything random.
        rate: simulated seconds per second.
        faults: that were planned, and what became of them.
        narrowest_s: when the robot was nearest to an obstacle, a building or the prohibited area.
    """

    run_id: str
    airport: AirportDrawing
    mission_name: str
    mission: Literal["success", "fail"]
    safety: Safety
    reasons: tuple[str, ...]
    duration_s: float
    distance_m: float
    track: tuple[tuple[float, float, float], ...]
    believed: tuple[tuple[float, float, float], ...]
    lights: tuple[LightResult, ...]
    steps: tuple[StepResult, ...]
    obstacles: tuple[ObstacleSeen, ...]
    events: tuple[EventLine, ...]
    intervals: tuple[Interval, ...]
    decisions: tuple[DecisionLine, ...]
    restarts: dict[str, int]
    collisions: int
    prohibited_s: float
    obstacle_clearance_m: float | None
    prohibited_clearance_m: float | None
    strategy: str
    seed: int
    rate: float
    faults: tuple[FaultOutcome, ...] = ()
    narrowest_s: float | None = None


class RunRecorder:
    """Builds a `RunRecord` from the messages of a run.

    Args:
        run_id: name of the run.
        airport: where it takes place.
        mission: to be driven.
        strategy: of the manager; empty without FTMs.
        seed: of everything random.
        rate: simulated seconds per second.
    """

    def __init__(self, run_id: str, airport: Airport, mission: Mission, *, strategy: str = "",
                 seed: int = 0, rate: float = 1.0) -> None:
        self._fixed = {"run_id": run_id, "strategy": strategy, "seed": seed, "rate": rate}
        self._airport = airport
        self._mission = mission
        self._track: list[tuple[float, float, float]] = []
        self._believed: list[tuple[float, float, float]] = []
        self._lights: dict[str, m.LightMeasurement] = {}
        self._reached: tuple[float, ...] = ()
        self._known_lights = frozenset(light.name for light in airport.lights)
        self._left_out = 0
        self._obstacles: dict[str, ObstacleSeen] = Remembered(KEPT)
        self._events: list[EventLine] = []
        self._intervals: list[Interval] = []
        self._open: dict[tuple[str, str], tuple[float, str]] = {}
        self._decisions: Remembered[tuple[int, int], DecisionLine] = Remembered(KEPT)
        self._restarts: dict[str, int] = Remembered(KEPT)
        self._lives: Remembered[tuple[str, int], None] = Remembered(KEPT)
        self._collisions = 0
        self._prohibited_s = 0.0
        self._obstacle_clearance_m = math.inf
        self._prohibited_clearance_m = math.inf
        self._narrowest_s: float | None = None
        self._injections: dict[str, str] = Remembered(KEPT)
        self._take: dict[str, Callable[[Any, Header], None]] = {
            topics.TRUTH.key: self._truth,
            topics.POSE.key: self._pose,
            topics.MISSION_STATUS.key: self._mission_status,
            topics.LIGHT_MEASURED.key: self._light,
            topics.OBSTACLES.key: self._obstacle_list,
            ftm_topics.DETECTION.key: self._detection,
            ftm_topics.MANAGER_STATUS.key: self._manager,
            ftm_topics.DECISION.key: self._decision,
            ftm_topics.SHADOW.key: self._shadow,
            topics.PILOT_STATUS.key: self._pilot,
            ftm_topics.PROCESS_EVENT.key: self._process_event,
            bus_topics.INJECT.key: self._injection,
            bus_topics.INJECTION_REPORT.key: self._injection_report,
        }

    @property
    def wanted(self) -> tuple[str, ...]:
        """Keys (below the root) of the topics it makes use of."""
        return tuple(self._take)

    def feed(self, topic: Topic[Any], message: Any, header: Header) -> None:
        """Take a message; those of other topics are ignored."""
        take = self._take.get(topic.key)
        if take is not None:
            take(message, header)

    def record(self, mission: Literal["success", "fail"], safety: Safety,
               reasons: Sequence[str], duration_s: float) -> RunRecord:
        """Return the record of the run so far, with the judge's verdict."""
        still = [Interval(lane, name, from_s, max(from_s, duration_s), reason)
                 for (lane, name), (from_s, reason) in self._open.items()]
        return RunRecord(
            **self._fixed,  # type: ignore[arg-type] # a dict of different types
            airport=draw(self._airport),
            mission_name=self._mission.name,
            mission=mission,
            safety=safety,
            reasons=tuple(reasons),
            duration_s=duration_s,
            distance_m=sum(math.dist(a[1:], b[1:])
                           for a, b in zip(self._track, self._track[1:], strict=False)),
            track=tuple(self._track),
            believed=tuple(self._believed),
            lights=tuple(self._light_result(light) for light in draw(self._airport).lights),
            steps=tuple(
                StepResult(str(goal.mode), goal.x_m, goal.y_m,
                           self._reached[i] if i < len(self._reached) else None)
                for i, goal in enumerate(self._mission.goals)),
            obstacles=tuple(self._obstacles.values()),
            events=(*sorted(self._events, key=lambda event: event.t_s),
                    *self._crowd(duration_s)),
            intervals=tuple(sorted((*self._intervals, *still), key=lambda bar: bar.from_s)),
            decisions=tuple(self._decisions.values()),
            restarts=dict(self._restarts),
            collisions=self._collisions,
            prohibited_s=self._prohibited_s,
            obstacle_clearance_m=_finite(self._obstacle_clearance_m),
            prohibited_clearance_m=_finite(self._prohibited_clearance_m),
            narrowest_s=self._narrowest_s,
        )

    def _crowd(self, now_s: float) -> tuple[EventLine, ...]:
        """Return a line about what there was no room for, if anything."""
        count = self._left_out + self._decisions.forgotten
        return (EventLine(now_s, "fault", f"{count} more events, intervals, decisions or points of "
                          "the way were not kept"),) if count else ()

    # -- one method per topic -------------------------------------------------------------------

    def _truth(self, truth: m.GroundTruth, header: Header) -> None:
        self._append(self._track, header.stamp, truth.pose)
        self._collisions = max(self._collisions, truth.collisions)
        self._prohibited_s = max(self._prohibited_s, truth.prohibited_s)
        if min(truth.obstacle_clearance_m, truth.prohibited_clearance_m) < min(
                self._obstacle_clearance_m, self._prohibited_clearance_m):
            self._narrowest_s = header.stamp
        self._obstacle_clearance_m = min(self._obstacle_clearance_m, truth.obstacle_clearance_m)
        self._prohibited_clearance_m = min(
            self._prohibited_clearance_m, truth.prohibited_clearance_m)

    def _pose(self, pose: m.Pose, header: Header) -> None:
        self._append(self._believed, header.stamp, pose)

    def _mission_status(self, status: m.MissionStatus, header: Header) -> None:
        for light in status.lights:
            self._light(light, header)
        newly = len(status.step_times_s) - len(self._reached)  # negative: it forgot, we do not
        self._reached += (header.stamp,) * newly

    def _light(self, light: m.LightMeasurement, _header: Header) -> None:
        if light.light in self._known_lights:
            self._lights[light.light] = light

    def _obstacle_list(self, listed: m.ObstacleList, _header: Header) -> None:
        for o in listed.obstacles:
            if o.present:
                self._obstacles[o.name] = ObstacleSeen(o.name, o.x_m, o.y_m, o.radius_m)

    def _detection(self, report: fm.DetectionReport, header: Header) -> None:
        active = report.state is fm.DetectionState.ACTIVE
        name = header.source
        if self._turn("detection", name, active, header.stamp, report.reason):
            text = f"{name} detects: {report.reason}" if active else f"{name} is idle again"
            self._note(header.stamp, "fault" if active else "clear", text)

    def _manager(self, status: fm.ManagerStatus, header: Header) -> None:
        for name in status.activated:
            self._turn("recovery", name, True, header.stamp)
        for lane, name in list(self._open):
            if lane == "recovery" and name not in status.activated:
                self._turn(lane, name, False, header.stamp)

    def _decision(self, record: fm.DecisionRecord, header: Header) -> None:
        self._decisions[header.incarnation, record.decision] = DecisionLine(
            header.stamp, record.decision, record.strategy, record.active, record.rule,
            record.recoveries,
            decision_in_words(record.active, record.rule, record.recoveries, record.strategy),
            record.path, record.rejected, record.detected_s)

    def _shadow(self, record: fm.ShadowRecord, header: Header) -> None:
        key = header.incarnation, record.decision
        if key in self._decisions:  # it is told right after the decision, on the same way
            self._decisions[key] = msgspec.structs.replace(
                self._decisions[key],
                shadow=f"{record.strategy}: {' and '.join(record.recoveries) or 'nothing'}")

    def _pilot(self, status: m.PilotStatus, header: Header) -> None:
        self._turn("stop", "Safety Pilot", status.stopped, header.stamp, status.reason)

    def _process_event(self, event: fm.ProcessEvent, header: Header) -> None:
        if event.detail == "already":  # the answer to a request that came twice
            return
        detail = f": {event.detail}" if event.detail else ""
        if event.event in _CRASHES:
            self._turn("down", event.node, True, header.stamp, event.event)
            self._note(header.stamp, "fault", f"{event.node} {event.event}{detail}")
        elif event.event in _RECOVERED:
            self._turn("down", event.node, False, header.stamp)
            by = f" by {event.by}" if event.by else ""
            self._note(header.stamp, "clear", f"{event.node} {event.event}{by}")
        if event.event == "respawned":
            life = event.node, event.incarnation
            if life not in self._lives:
                self._lives[life] = None
                self._restarts[event.node] = self._restarts.get(event.node, 0) + 1

    def _injection(self, order: bm.Injection, _header: Header) -> None:
        self._injections[order.injection] = f"{order.mode} {order.topic}"

    def _injection_report(self, report: bm.InjectionReport, header: Header) -> None:
        what = self._injections.get(report.injection, report.injection)
        if self._turn("injection", report.injection, not report.finished, header.stamp, what):
            if report.finished:
                text = (f"injection over: {what} at {report.node}, "
                        f"{report.affected} messages changed")
            else:
                text = f"fault injected: {what} at {report.node}"
            self._note(header.stamp, "clear" if report.finished else "fault", text)

    # -- helpers --------------------------------------------------------------------------------

    def _turn(self, lane: str, name: str, on: bool, t_s: float, reason: str = "") -> bool:
        """Begin or end an interval; return whether that changed anything."""
        slot = (lane, name)
        if on == (slot in self._open):
            return False
        if on and len(self._open) >= KEPT:
            self._left_out += 1
            return False
        if on:
            self._open[slot] = (t_s, reason)
            return True
        from_s, why = self._open.pop(slot)
        if self._has_room(self._intervals, KEPT):
            self._intervals.append(Interval(lane, name, from_s, max(from_s, t_s), why))
        return True

    def _note(self, t_s: float, kind: str, text: str) -> None:
        if self._has_room(self._events, KEPT):
            self._events.append(EventLine(t_s, kind, text))

    def _has_room(self, kept: list[Any], most: int) -> bool:
        """Whether one more may be kept; if not it is counted."""
        if len(kept) < most:
            return True
        self._left_out += 1
        return False

    def _append(self, track: list[tuple[float, float, float]], t_s: float, pose: m.Pose) -> None:
        if not (math.isfinite(pose.x_m) and math.isfinite(pose.y_m)):
            return
        moved = not track or math.dist(track[-1][1:], (pose.x_m, pose.y_m)) >= TRACK_STEP_M
        if moved and self._has_room(track, TRACK_KEPT):
            track.append((round(t_s, 2), round(pose.x_m, 3), round(pose.y_m, 3)))

    def _light_result(self, light: Any) -> LightResult:
        known = (light.name, light.row, light.x_m, light.y_m, light.nominal_cd)
        seen = self._lights.get(light.name)
        if seen is None:
            return LightResult(*known)
        return LightResult(*known, seen.verdict.value, seen.intensity_cd, seen.ratio)


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
