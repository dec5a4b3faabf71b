"""What the operator's page shows: the latest of everything, and a few short logs. Pure.

Keeping is cheap, because it happens for every message; the JSON-like snapshot is only built
while somebody looks.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Any

from actors import messages as m
from manager.words import decision_in_words

TRACK_STEP_M = 0.25
"""A track point is kept when the robot has moved this far."""

TRACK_POINTS = 4000
LOG_LINES = 60
STALE_S = 1.5
"""A state that was not heard for so long is shown as stale (simulated seconds)."""

_ROUTINE = ("started", "running")
_GOOD_NEWS = ("respawned", "resumed", "adopted")


class HmiState:
    """The operator's picture of the system, as far as the HMI has heard of it."""

    def __init__(self) -> None:
        self.track: deque[tuple[float, float]] = deque(maxlen=TRACK_POINTS)
        self._latest: dict[str, tuple[Any, float]] = {}
        self._detections: dict[str, m.DetectionView] = {}
        self._lights: dict[str, m.LightMeasurement] = {}
        self._log: deque[dict[str, Any]] = deque(maxlen=LOG_LINES)
        self._decisions: deque[dict[str, Any]] = deque(maxlen=LOG_LINES)
        self._mission_id = ""
        self._outcomes = 0
        self._outcome = ""

    # -- hearing --------------------------------------------------------------------------------

    def keep(self, what: str, message: Any, now_s: float) -> None:
        """Keep the latest message of a kind ("pose", "route", "pilot", ...)."""
        self._latest[what] = (message, now_s)

    def pose(self, pose: m.Pose, now_s: float) -> None:
        """Keep the pose, and a point of the track if the robot has moved."""
        self._latest["pose"] = (pose, now_s)
        at = (pose.x_m, pose.y_m)
        if not all(map(math.isfinite, at)):
            return
        if not self.track or math.dist(self.track[-1], at) >= TRACK_STEP_M:
            self.track.append((round(pose.x_m, 2), round(pose.y_m, 2)))

    def mission(self, status: m.MissionStatus, now_s: float) -> None:
        """Keep the mission's state; a new mission starts with unmeasured lights."""
        if status.mission_id and status.mission_id != self._mission_id:
            self._mission_id = status.mission_id
            self._lights.clear()
        self._latest["mission"] = (status, now_s)
        for light in status.lights:
            self._lights[light.light] = light

    def light(self, measured: m.LightMeasurement) -> None:
        """Keep the measurement of a light."""
        self._lights[measured.light] = measured

    def manager(self, status: m.ManagerStatus, now_s: float) -> None:
        """Keep the manager's view, and log which detections have come and gone."""
        before = self._detections
        self._detections = {view.name: view for view in status.detections}
        self._latest["manager"] = (status, now_s)
        for name, view in self._detections.items():
            if view.active != (name in before and before[name].active):
                text = f"{name} detects: {view.reason}" if view.active else f"{name} is idle again"
                self.log(now_s, "fault" if view.active else "clear", text)

    def decision(self, record: m.DecisionRecord, now_s: float) -> None:
        """Add a decision of the manager to the decision log."""
        self._decisions.append({
            "t": round(now_s, 2),
            "number": record.decision,
            "active": record.active,
            "block": record.rule,
            "recoveries": record.recoveries,
            "words": decision_in_words(
                record.active, record.rule, record.recoveries, record.strategy),
            "path": record.path,
            "rejected": [f"{name}: {why}" for name, why in record.rejected],
        })

    def process_event(self, event: m.ProcessEvent, now_s: float) -> None:
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
        self._outcome = outcome
        self.log(now_s, "note", f"order to the mission: {outcome}")

    def diagnostic(self, report: m.Diagnostic, now_s: float) -> None:
        """Log an error report of a node."""
        times = f" ({report.count} times)" if report.count > 1 else ""
        self.log(now_s, "note",
                 f"{report.node}: {report.context}: {report.reason} [{report.offender}]{times}")

    def log(self, now_s: float, kind: str, text: str) -> None:
        """Add a line to the event log; `kind` is fault, clear or note."""
        self._log.append({"t": round(now_s, 2), "kind": kind, "text": text})

    # -- showing --------------------------------------------------------------------------------

    @property
    def latched(self) -> tuple[str, ...]:
        """Recoveries that wait for the operator's reset, as the manager last said."""
        manager = self._latest.get("manager")
        return manager[0].latched if manager else ()

    def snapshot(self, now_s: float) -> dict[str, Any]:
        """Return everything the page shows, ready for JSON; times in simulated seconds."""
        manager = self._aged("manager", now_s)
        return {
            "type": "state",
            "time_s": round(now_s, 2),
            "pose": self._aged("pose", now_s),
            "mission": self._mission(now_s),
            "order": {"number": self._outcomes, "text": self._outcome},
            "route": self._route(),
            "control": self._aged("control", now_s),
            "pilot": self._aged("pilot", now_s),
            "manager": manager,
            "nodes": self._aged("nodes", now_s),
            "detections": [
                {"name": name, "active": view.active, "reason": view.reason, "nodes": view.nodes,
                 "stale": manager is None or manager["stale"]}
                for name, view in sorted(self._detections.items())
            ],
            "lights": {
                name: {"verdict": light.verdict, "ratio": round(light.ratio, 3),
                       "intensity_cd": round(light.intensity_cd, 1)}
                for name, light in self._lights.items()
            },
            "obstacles": [
                o for o in self._value("obstacles", m.ObstacleList(())).obstacles if o.present
            ],
            "decisions": list(self._decisions),
            "events": list(self._log),
        }

    def _value(self, what: str, default: Any) -> Any:
        found = self._latest.get(what)
        return found[0] if found else default

    def _aged(self, what: str, now_s: float) -> dict[str, Any] | None:
        found = self._latest.get(what)
        if found is None:
            return None
        message, at_s = found
        return {"value": message, "stale": now_s - at_s > STALE_S}

    def _mission(self, now_s: float) -> dict[str, Any] | None:
        found = self._latest.get("mission")
        if found is None:
            return None
        status, at_s = found
        return {
            "name": status.name, "phase": status.phase, "step": status.step,
            "goals": status.goals, "times_s": status.step_times_s, "reason": status.reason,
            "stale": now_s - at_s > STALE_S, "orders": status.orders, "skipped": status.skipped,
        }

    def _route(self) -> tuple[tuple[float, float], ...]:
        route = self._value("route", None)
        return route.waypoints if route is not None and route.active else ()
