"""The lines of Osmosis in `rampart status`, `rampart top` and `rampart live metrics`. Pure."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping
from typing import Any

from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.cli.robot_lines import SILENT, Latest, RobotLines, Row


class OsmosisLines(RobotLines):
    """Mission, robot, Safety Pilot, and safety by the ground truth."""

    read = (topics.MISSION_STATUS, topics.CONTROL_STATUS, topics.POSE, topics.PILOT_STATUS,
            topics.BASE_STATUS, topics.TRUTH)
    status_read = (topics.MISSION_STATUS, topics.PILOT_STATUS, topics.BASE_STATUS)

    def status(self, latest: Latest, plan: Mapping[str, Any], kinds: Collection[str]
               ) -> list[tuple[str, str]]:
        """Return mission and Safety Pilot, as far as the run has them."""
        mission, pilot = latest(topics.MISSION_STATUS), latest(topics.PILOT_STATUS)
        driving = pilot_in_words(pilot, latest(topics.BASE_STATUS))
        return [(label, text) for label, text, there in (
            ("mission", mission_in_words(mission), mission or plan.get("mission", True)),
            ("pilot", driving, pilot or "pilot" in kinds)) if there]

    def status_data(self, latest: Latest) -> dict[str, Any]:
        """Return the same as data."""
        return {"mission": latest(topics.MISSION_STATUS), "pilot": latest(topics.PILOT_STATUS)}

    def rows(self, latest: Latest) -> list[Row]:
        """Return the lines of `rampart top`."""
        pilot: m.PilotStatus | None = latest(topics.PILOT_STATUS)
        base: m.BaseStatus | None = latest(topics.BASE_STATUS)
        safety = _safety(latest(topics.TRUTH))
        return [
            Row("mission", mission_in_words(latest(topics.MISSION_STATUS)), "",
                topics.MISSION_STATUS),
            Row("robot", _robot(latest), "", topics.POSE),
            Row("pilot", pilot_in_words(pilot, base),
                "yellow" if (pilot and pilot.stopped) or (base and base.brake_engaged) else "",
                topics.PILOT_STATUS),
            Row("safety", safety or "not known: no ground truth",
                "bold red" if "UNSAFE" in safety else "", topics.TRUTH)]

    def data(self, latest: Latest) -> dict[str, Any]:
        """Return the same as data."""
        return {**self.status_data(latest), "pose": latest(topics.POSE),
                "control": latest(topics.CONTROL_STATUS),
                "safety": _safety(latest(topics.TRUTH)) or None}

    def families(self, latest: Latest) -> Iterator[Any]:
        """Yield mission, Safety Pilot and safety for Prometheus."""
        from prometheus_client.core import StateSetMetricFamily  # noqa: PLC0415 of the extra

        from rampart.cli.look.live_metrics import counter, gauge  # noqa: PLC0415 of the extra

        status: m.MissionStatus | None = latest(topics.MISSION_STATUS)
        pilot: m.PilotStatus | None = latest(topics.PILOT_STATUS)
        if status is not None:
            yield StateSetMetricFamily("rampart_mission_phase", "State of the mission.", value={
                phase.value: phase is status.phase for phase in m.MissionPhase})
            yield gauge("mission_step", "Goals reached or skipped.", ("mission",), [
                ((status.name,), status.step)])
            yield gauge("mission_steps", "Goals of the mission.", ("mission",), [
                ((status.name,), len(status.goals))])
            yield gauge("lights_measured", "Lights measured, by verdict.", ("verdict",), [
                ((verdict.value,), sum(light.verdict is verdict for light in status.lights))
                for verdict in m.LightVerdict])
        if pilot is not None:
            yield StateSetMetricFamily("rampart_pilot_mode", "Mode of the Safety Pilot.", value={
                mode.value: mode is pilot.mode for mode in m.PilotMode})
            yield gauge("pilot_stopped", "Whether the Safety Pilot holds the robot.", (), [
                ((), float(pilot.stopped))])
            yield counter("pilot_refused_commands", "Commands that the Safety Pilot refused.", (),
                          [((), pilot.refused_commands)])
        truth: m.GroundTruth | None = latest(topics.TRUTH)
        if truth is None:
            return
        yield gauge("obstacle_clearance_meters", "Footprint to the nearest obstacle.", (), [
            ((), truth.obstacle_clearance_m)])
        yield gauge("prohibited_clearance_meters", "Footprint to the prohibited area.", (), [
            ((), truth.prohibited_clearance_m)])
        yield counter("collisions", "Collisions, by ground truth.", (), [((), truth.collisions)])
        yield counter("prohibited_seconds", "Time in the prohibited area, by ground truth.", (), [
            ((), truth.prohibited_s)])


def mission_in_words(status: m.MissionStatus | None) -> str:
    """Return how far the mission is."""
    if status is None:
        return SILENT
    if not status.goals:
        return status.phase.value
    steps = len(status.goals)
    text = (f"{status.name} {status.phase.value}, step {min(status.step + 1, steps)} of {steps}, "
            f"{len(status.lights)} lights measured")
    return f"{text}: {status.reason}" if status.reason else text


def pilot_in_words(status: m.PilotStatus | None, base: m.BaseStatus | None = None) -> str:
    """Return the mode of the Safety Pilot, and whether it or a brake holds the robot."""
    if status is None:
        return SILENT
    braked = base is not None and base.brake_engaged
    doing = "BRAKED" if braked else "STOPPED" if status.stopped else "driving"
    text = f"{status.mode.value}, {doing}"
    return f"{text}: {status.reason}" if status.reason else text


def _robot(latest: Latest) -> str:
    pose: m.Pose | None = latest(topics.POSE)
    if pose is None:
        return "no pose"
    text = f"x {pose.x_m:.2f} m  y {pose.y_m:.2f} m  heading {math.degrees(pose.yaw_rad):.0f} deg"
    control: m.ControlStatus | None = latest(topics.CONTROL_STATUS)
    if control is not None:
        text += f"  {control.phase.value}, {control.distance_to_go_m:.1f} m to go"
    return text


def _safety(truth: m.GroundTruth | None) -> str:
    """Return the safety by the ground truth, as the judge decides it; "" without ground truth."""
    if truth is None:
        return ""
    harm = [text for text, there in (
        (f"{truth.collisions} collisions", truth.collisions > 0),
        (f"{truth.prohibited_s:.1f} s in the prohibited area", truth.prohibited_s > 0)) if there]
    near = (f"nearest obstacle {truth.obstacle_clearance_m:.2f} m, "
            f"prohibited area {truth.prohibited_clearance_m:.2f} m")
    return f"UNSAFE: {', '.join(harm)}; {near}" if harm else f"safe so far; {near}"
