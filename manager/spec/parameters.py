"""Which parameters the shipped detection and recovery modules take, and with which values.

A module reads its parameters when it starts, and one that it cannot use ends it: at once, and at
each respawn. So they are checked when the spec is read. The manager knows actors by the path of
their class only and imports none; hence this table, which a test holds against the classes.
A module of somebody else's is not in it, and takes what it likes.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from typing import Any

Check = Callable[[Any, Collection[str]], str]
"""Given a value and the names of the nodes, says what would be right; "" if the value is."""


def _number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _amount(value: Any, _nodes: Collection[str]) -> str:
    return "" if _number(value) and value >= 0 else "expected a number, 0 or more"


def _above_zero(value: Any, _nodes: Collection[str]) -> str:
    return "" if _number(value) and value > 0 else "expected a number > 0"


def _list_of_nodes(value: Any, nodes: Collection[str]) -> str:
    good = isinstance(value, list) and value and all(isinstance(n, str) and n in nodes
                                                     for n in value)
    return "" if good else f"expected a list of node names; known: {', '.join(nodes)}"


def _node(value: Any, nodes: Collection[str]) -> str:
    good = isinstance(value, str) and value in nodes
    return "" if good else f"expected the name of a node; known: {', '.join(nodes)}"


def _osmosis_and_standby(value: Any, nodes: Collection[str]) -> str:
    good = not _list_of_nodes(value, nodes) and len(set(value)) == len(value) == 2 \
        and "osmosis_control" in value
    return "" if good else "expected osmosis_control and its standby"


def _one_of(*words: str) -> Check:
    return lambda value, _: "" if value in words else f"expected {' or '.join(map(repr, words))}"


_FRESH = {"timeout_s": _above_zero, "hold_s": _amount, "suspects": _list_of_nodes,
          "startup_grace_s": _amount}

TAKES: dict[str, dict[str, Check]] = {
    "rampart.actors.osmosis.detection.actuator_failure:ActuatorFailure": {
        "wheel_radius_m": _amount, "hold_s": _amount},
    "rampart.actors.osmosis.detection.bounds:Bounds": {
        "hold_s": _amount, "suspects": _list_of_nodes},
    "rampart.actors.osmosis.detection.command_disagreement:CommandDisagreement": {
        "suspects": _osmosis_and_standby, "linear_mps": _amount, "angular_radps": _amount,
        "linear_s": _amount, "angular_s": _amount, "hold_s": _amount},
    "rampart.actors.osmosis.detection.erroneous_route:ErroneousRoute": {"hold_s": _amount},
    "rampart.actors.osmosis.detection.area.estimation_error:EstimationError": {
        "startup_grace_s": _amount},
    "rampart.actors.osmosis.detection.freshness:CommandFreshness": {
        **_FRESH, "topic": _one_of("control/command")},
    "rampart.actors.osmosis.detection.freshness:LocalizationFreshness": {
        **_FRESH, "topic": _one_of("localization/pose")},
    "rampart.actors.osmosis.detection.mission_consistency:MissionConsistency": {
        "patience_s": _amount, "silence_s": _amount},
    "rampart.actors.osmosis.detection.pilot_output:PilotOutput": {
        "pilot": _node, "timeout_s": _above_zero, "wrong_s": _amount, "hold_s": _amount,
        "startup_grace_s": _amount},
    "rampart.actors.osmosis.detection.area.prohibited_area:ProhibitedArea": {
        "margin_m": _above_zero, "gps_timeout_s": _amount, "hold_s": _amount,
        "startup_grace_s": _amount},
    "rampart.actors.osmosis.detection.area.voted_area:VotedArea": {
        "margin_m": _above_zero, "unknown_s": _amount, "hold_s": _amount, "blind_s": _amount,
        "blind_m": _amount, "startup_grace_s": _amount},
    "rampart.actors.detection.watchdog:Watchdog": {
        "watch": _list_of_nodes, "timeout_s": _above_zero, "startup_grace_s": _amount},
    "rampart.actors.osmosis.recovery.controlled_stop:ControlledStop": {},
    "rampart.actors.osmosis.recovery.emergency_stop:EmergencyStop": {},
    "rampart.actors.osmosis.recovery.reduced_speed:ReducedSpeed": {"top_speed_mps": _above_zero},
    "rampart.actors.osmosis.recovery.replan:Replan": {},
    "rampart.actors.recovery.respawn:Respawn": {"nodes": _list_of_nodes},
    "rampart.actors.osmosis.recovery.respawn_braked:RespawnBraked": {"nodes": _list_of_nodes},
    "rampart.actors.osmosis.recovery.switch_teleoperation:SwitchTeleoperation": {},
    "rampart.actors.detection.stub:StubDetection": {
        "timeout_s": _above_zero, "margin_m": _above_zero, "watch": _list_of_nodes},
    "rampart.actors.recovery.stub:StubRecovery": {
        "takes_s": _amount, "ends": _one_of("degraded", "done", "failed")},
}
"""By class. A freshness module's `topic` says again what the class says. What `StubDetection` takes
is read by nobody but the analyses: it stands for a module that is not written yet.
"""

NEEDS = {"rampart.actors.detection.watchdog:Watchdog": "watch",
         "rampart.actors.recovery.respawn:Respawn": "nodes",
         "rampart.actors.osmosis.recovery.respawn_braked:RespawnBraked": "nodes"}
"""Without this one the module does not start."""

TIMES_OUT_ON = {
    "rampart.actors.osmosis.detection.freshness:CommandFreshness": "control_period_s",
    "rampart.actors.osmosis.detection.freshness:LocalizationFreshness": "control_period_s",
    "rampart.actors.osmosis.detection.pilot_output:PilotOutput": "control_period_s",
    "rampart.actors.detection.watchdog:Watchdog": "heartbeat_period_s",
}
"""The period of `[timing]` with which comes what a module's `timeout_s` waits for."""


def find_wrong(actor: str, parameters: Mapping[str, Any], nodes: Collection[str],
               derived: Collection[str] = ()) -> Iterator[tuple[str, str]]:
    """Find parameters that a module does not take, with that name or with that value.

    Args:
        actor: Class of the module; one that is not shipped may have any parameters.
        parameters: As the spec gives them, names of times replaced by the times.
        nodes: Names of the system's nodes.
        derived: Parameters that the module is given besides.

    Yields:
        Name of a parameter, and what would be right.
    """
    takes = TAKES.get(actor)
    if takes is None:
        return
    for name, value in parameters.items():
        if name not in takes:
            yield name, (f"unknown parameter; {actor.rpartition(':')[2]} takes "
                         f"{', '.join(takes) or 'none'}")
        elif problem := takes[name](value, nodes):
            yield name, problem
    needed = NEEDS.get(actor, "")
    if needed and needed not in parameters and needed not in derived:
        yield needed, "missing; without it the module does not start"
