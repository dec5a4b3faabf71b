"""What the HMI has heard, as pages are to see it: fills the picture. Pure.

Keeping is cheap, because it happens for every message: a state that says the same again changes
nothing, and nothing is turned into JSON unless somebody looks (`hmi_picture`).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import msgspec

from rampart.actors.bus import messages as bm
from rampart.actors.ftm import messages as fm
from rampart.actors.operator.bounds import MAX_NAME, SHOWN, Bounds, clip
from rampart.actors.operator.picture import Picture
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis.page.laser import thin
from rampart.manager.strategies.decision_words import decision_in_words

TRACK_STEP_M = 0.25
"""A track point is kept when the robot has moved this far."""

TRACK_POINTS = 4000
MAX_LIGHTS = 1500
"""So many lights are shown of an airport: an SVG with more is slow on a telephone."""

STALE_S = 1.5
"""A state that was not heard for so long is shown as stale (simulated seconds)."""

_AGED = ("pose", "mission", "control", "pilot", "manager", "nodes", "laser", "upper_laser")
"""Sections that are stale if nothing has been heard for a while."""

_ROUTE = Bounds(items=1000, room=30_000)
_SYSTEM = Bounds(text=40_000, items=1000, room=100_000)
"""Of what was laid out here, of up to 300 boxes (`hmi_system`)."""

_ROUTINE = ("started", "running")
_GOOD_NEWS = ("respawned", "resumed", "adopted")


class _Heard(msgspec.Struct):
    """A message, and whether the next one is overdue; pages see {"value", "stale"}."""

    value: Any
    stale: bool = False
    t: float = 0.0
    """When the content was true; only where a page needs it."""


class HmiState:
    """The operator's picture of the system, as far as the HMI has heard of it.

    Args:
        lights: names of the lights that are shown; None for any, up to `MAX_LIGHTS`.

    Attributes:
        picture: what pages are shown.
        track: where the robot was, (x, y) in `map`.
    """

    def __init__(self, lights: Collection[str] | None = None) -> None:
        self._lights = None if lights is None else frozenset(lights)
        self.track: deque[tuple[float, float]] = deque(maxlen=TRACK_POINTS)
        self.picture = picture = Picture()
        self._heard_s: dict[str, float] = {}
        self._detections: dict[str, fm.DetectionView] = {}
        self._mission_id = ""
        self._outcomes = 0
        picture.section("system", bounds=_SYSTEM)
        picture.section("pose", show=_with_time)
        for name in ("laser", "upper_laser"):
            picture.section(name, show=_sweep)
        picture.section("mission", show=_mission)
        picture.section("order", {"number": 0, "text": ""})
        picture.section("route", (), _route, _ROUTE)
        for name in ("control", "pilot", "manager", "nodes"):
            picture.section(name, show=_aged)
        picture.section("detections", [])
        picture.table("lights", MAX_LIGHTS)
        picture.section("obstacles", ())
        picture.section("usage", {})
        picture.journal("decisions")
        picture.journal("events")

    # -- hearing --------------------------------------------------------------------------------

    def keep(self, what: str, message: Any, now_s: float) -> None:
        """Keep the latest message of a kind: control, pilot, nodes."""
        self._heard_s[what] = now_s
        self.picture.put(what, _Heard(message))

    def pose(self, pose: m.Pose, stamp_s: float, now_s: float) -> None:
        """Keep the pose, and a point of the track if the robot has moved."""
        self._heard_s["pose"] = now_s
        self.picture.put("pose", _Heard(pose, False, stamp_s))
        at = (pose.x_m, pose.y_m)
        if not all(map(math.isfinite, at)):
            return
        if not self.track or math.dist(self.track[-1], at) >= TRACK_STEP_M:
            self.track.append((round(pose.x_m, 2), round(pose.y_m, 2)))

    def laser(self, which: str, scan: m.LaserScan, now_s: float) -> None:
        """Keep a sweep of "laser" or "upper_laser"; it may wait for the next pose."""
        self._heard_s[which] = now_s
        self.picture.put(which, _Heard(scan), urgent=False)

    def route(self, route: m.Route) -> None:
        """Keep the way to the goal; none while there is no goal."""
        self.picture.put("route", route.waypoints if route.active else ())

    def obstacles(self, obstacles: m.ObstacleList) -> None:
        """Keep the obstacles that are there."""
        self.picture.put("obstacles", tuple(o for o in obstacles.obstacles if o.present))

    def mission(self, status: m.MissionStatus, now_s: float) -> None:
        """Keep the mission's state; a new mission starts with unmeasured lights."""
        if status.mission_id and status.mission_id != self._mission_id:
            self._mission_id = status.mission_id
            for name in self.picture.rows("lights"):
                self.picture.put_row("lights", name, None)
        self._heard_s["mission"] = now_s
        self.picture.put("mission", _Heard(status))
        for light in status.lights:
            self.light(light)

    def light(self, measured: m.LightMeasurement) -> None:
        """Keep the measurement of a light that is shown."""
        name = measured.light
        if len(name) <= MAX_NAME and (self._lights is None or name in self._lights):
            self.picture.put_row("lights", name, {
                "verdict": measured.verdict, "ratio": round(measured.ratio, 3),
                "intensity_cd": round(measured.intensity_cd, 1)})

    def manager(self, status: fm.ManagerStatus, now_s: float) -> None:
        """Keep the manager's view, and log which detections have come and gone."""
        before = self._detections
        self._detections = {view.name: view for view in status.detections[:SHOWN.items]}
        self._heard_s["manager"] = now_s
        self.picture.put("manager", _Heard(status))
        self._show_detections(False)
        for name, view in self._detections.items():
            if view.active != (name in before and before[name].active):
                text = f"{name} detects: {view.reason}" if view.active else f"{name} is idle again"
                self.log(now_s, "fault" if view.active else "clear", text)

    def decision(self, record: fm.DecisionRecord, now_s: float) -> None:
        """Add a decision of the manager to the decision log."""
        self.picture.add("decisions", {
            "t": round(now_s, 2),
            "number": record.decision,
            "active": record.active,
            "block": record.rule,
            "strategy": record.strategy,
            "recoveries": record.recoveries,
            "words": decision_in_words(
                record.active, record.rule, record.recoveries, record.strategy),
            "rule": f"{record.rule} of {record.strategy}",
            "path": record.path,
            "rejected": [f"{name}: {why}" for name, why in record.rejected],
        })

    def process_event(self, event: fm.ProcessEvent, now_s: float) -> None:
        """Log what happened to a process; that all start at the start is no news."""
        if event.event in _ROUTINE:
            return
        by = f" by {event.by}" if event.event == "respawned" and event.by else ""
        detail = f": {event.detail}" if event.detail else ""
        kind = "clear" if event.event in _GOOD_NEWS else "fault"
        self.log(now_s, kind, f"{event.node} {event.event}{by}{detail}")

    def order(self, outcome: str, now_s: float) -> None:
        """Log what became of an order of the operator, and keep it to be shown."""
        self._outcomes += 1
        self.picture.put("order", {"number": self._outcomes, "text": outcome})
        self.log(now_s, "note", f"order to the mission: {outcome}")

    def announce(self, text: str, now_s: float) -> None:
        """Log what became of something the operator asked for, and keep it to be shown."""
        self._outcomes += 1
        self.picture.put("order", {"number": self._outcomes, "text": text})
        self.log(now_s, "note", text)

    def diagnostic(self, report: bm.Diagnostic, now_s: float) -> None:
        """Log an error report of a node."""
        times = f" ({report.count} times)" if report.count > 1 else ""
        self.log(now_s, "note",
                 f"{report.node}: {report.context}: {report.reason} [{report.offender}]{times}")

    def log(self, now_s: float, kind: str, text: str) -> None:
        """Add a line to the event log; `kind` is fault, clear or note."""
        self.picture.add("events", {"t": round(now_s, 2), "kind": kind, "text": clip(text)})

    def system(self, drawing: Mapping[str, Any] | None) -> None:
        """Keep the drawing of the system's fault tree and order (`hmi_system`)."""
        self.picture.put("system", drawing)

    def usage(self, usage: Mapping[str, Any]) -> None:
        """Keep what the processes use."""
        self.picture.put("usage", usage, urgent=False)

    # -- showing --------------------------------------------------------------------------------

    @property
    def latched(self) -> tuple[str, ...]:
        """Recoveries that wait for the operator's reset, as the manager last said."""
        manager = self.picture.value("manager")
        return manager.value.latched if manager else ()

    def grow_old(self, now_s: float) -> None:
        """Mark as stale what was not heard for a while; to be called before showing."""
        for name in _AGED:
            heard = self.picture.value(name)
            if heard is None or heard.stale or now_s - self._heard_s[name] <= STALE_S:
                continue
            self.picture.put(name, msgspec.structs.replace(heard, stale=True))
            if name == "manager":
                self._show_detections(True)

    def snapshot(self, now_s: float) -> dict[str, Any]:
        """Return everything the page shows, ready for JSON; times in simulated seconds."""
        self.grow_old(now_s)
        return {"type": "state", "time_s": round(now_s, 2), **self.picture.all()}

    def _show_detections(self, stale: bool) -> None:
        self.picture.put("detections", [
            {"name": name, "active": view.active, "reason": view.reason, "nodes": view.nodes,
             "stale": stale}
            for name, view in self._detections.items()])


def _aged(heard: _Heard | None) -> dict[str, Any] | None:
    return None if heard is None else {"value": heard.value, "stale": heard.stale}


def _with_time(heard: _Heard | None) -> dict[str, Any] | None:
    return None if heard is None else {**(_aged(heard) or {}), "t": round(heard.t, 4)}


def _sweep(heard: _Heard | None) -> dict[str, Any] | None:
    return None if heard is None or heard.stale else thin(heard.value)


def _route(waypoints: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    return [(round(x, 2), round(y, 2)) for x, y in waypoints]


def _mission(heard: _Heard | None) -> dict[str, Any] | None:
    if heard is None:
        return None
    status: m.MissionStatus = heard.value
    return {
        "name": status.name, "phase": status.phase, "step": status.step,
        "goals": status.goals, "times_s": status.step_times_s, "reason": status.reason,
        "stale": heard.stale, "orders": status.orders, "skipped": status.skipped,
    }
