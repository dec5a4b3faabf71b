"""Reports of fault tolerance to ROS 2: `/diagnostics` (REP-107), and each decision."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import Any

from rampart.actors.ftm.messages import (
    DecisionRecord,
    DetectionReport,
    DetectionState,
    RecoveryReport,
)
from rampart.actors.ros2.node import RosNode
from rampart.actors.ros2.ros_clock import NS
from rampart.actors.ros2.wire import Qos
from rampart.manager.model.mechanisms import RecoveryPhase

DIAGNOSTICS, DIAGNOSTICS_TYPE = "/diagnostics", "diagnostic_msgs/msg/DiagnosticArray"
DECISION, DECISION_TYPE = "/rampart/decision", "rampart_msgs/msg/Decision"

OK, WARN, ERROR, STALE = 0, 1, 2, 3
"""Levels of diagnostic_msgs/msg/DiagnosticStatus."""

_STALE_S = 1.5
"""Simulated seconds of silence after which a module is stale; modules report every second."""


class Diagnostics:
    """Reports detections, recoveries and decisions to ROS 2.

    Args:
        node: that publishes the reports.
        titles: of all detection and recovery modules, by name.
        hardware: value of `hardware_id`, the system's name.
        stamp_ns: returns the time of ROS 2, ns.
    """

    def __init__(self, node: RosNode, titles: Mapping[str, str], hardware: str,
                 stamp_ns: Callable[[], int]) -> None:
        self._types, self._titles, self._hardware = node.types, titles, hardware
        self._stamp_ns = stamp_ns
        self._reports: dict[str, tuple[DetectionReport | RecoveryReport, float]] = {}
        self._put = node.publisher(DIAGNOSTICS, DIAGNOSTICS_TYPE, Qos(depth=1))
        self._decide = node.publisher(
            DECISION, DECISION_TYPE, Qos(transient_local=True, depth=10))

    def take(self, name: str, report: DetectionReport | RecoveryReport, now_s: float) -> bool:
        """Keep a module's report; return whether its level has changed."""
        before = self._reports.get(name)
        self._reports[name] = report, now_s
        return before is None or _level(before[0]) != _level(report)

    def publish(self, now_s: float) -> None:
        """Publish the state of all modules."""
        types = self._types
        array = types.blank(DIAGNOSTICS_TYPE)
        self._stamp(array.header)
        for name, title in self._titles.items():
            report, at_s = self._reports.get(name, (None, 0.0))
            status = types.blank("diagnostic_msgs/msg/DiagnosticStatus")
            status.name = f"rampart: {name} {title}"
            status.hardware_id = self._hardware
            stale = report is None or now_s - at_s > _STALE_S
            status.level = STALE if stale or report is None else _level(report)
            status.message = "no report" if report is None else (
                "no recent report" if stale else report.reason or report.state.value)
            if report is not None:
                status.values = [self._pair(key, value) for key, value in _values(report).items()]
            array.status.append(status)
        self._put(types.encode(DIAGNOSTICS_TYPE, array))

    def decided(self, record: DecisionRecord) -> None:
        """Publish a decision with its certificate."""
        made = self._types.blank(DECISION_TYPE)
        self._stamp(made.header)
        made.number = record.decision % 2**32
        made.active, made.recoveries = list(record.active), list(record.recoveries)
        made.certificate = json.dumps({
            "strategy": record.strategy, "rule": record.rule, "path": record.path,
            "rejected": record.rejected, "detected_s": record.detected_s})
        self._decide(self._types.encode(DECISION_TYPE, made))

    def _stamp(self, header: Any) -> None:
        header.stamp.sec, header.stamp.nanosec = divmod(max(self._stamp_ns(), 0), NS)

    def _pair(self, key: str, value: str) -> Any:
        pair = self._types.blank("diagnostic_msgs/msg/KeyValue")
        pair.key, pair.value = key, value
        return pair


def _level(report: DetectionReport | RecoveryReport) -> int:
    if isinstance(report, DetectionReport):
        return ERROR if report.state is DetectionState.ACTIVE else OK
    if report.phase is RecoveryPhase.FAILED:
        return ERROR
    return OK if report.phase is RecoveryPhase.IDLE else WARN


def _values(report: DetectionReport | RecoveryReport) -> dict[str, str]:
    if isinstance(report, DetectionReport):
        return {"state": report.state.value, "nodes": ", ".join(report.nodes),
                "since_s": f"{report.since_s:.3f}"}
    return {"state": report.state.value, "phase": report.phase.value,
            "decision": str(report.decision)}
