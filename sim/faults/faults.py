"""The faults that can be injected by name: the paper's, those of the sensors, and `MODE:TOPIC`.

Crashes are not here: to crash a node, kill it (`kill-node`).
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from typing import Any

from rampart.actors.bus.topic import Topic
from rampart.actors.osmosis import topics
from rampart.sim.faults.disturbance import Disturbance, Fault, UnknownFaultError
from rampart.sim.faults.topic_faults import topic_fault
from rampart.sim.osmosis.sensor_faults import LEFT_OUT, sensor_faults

__all__ = ["CATALOGUE", "PAPER_FAULTS", "SENSOR_FAULTS", "Disturbance", "Fault",
           "UnknownFaultError", "find_fault"]

_COMMAND = topics.COMMAND.key
_POSE = topics.POSE.key
_GROUP = "paper"

PAPER_FAULTS: Mapping[str, Fault] = {fault.name: fault for fault in (
    Fault("command-not-updated",
          "Osmosis Control repeats its last velocity command for ever",
          (Disturbance(_COMMAND, "freeze"),), ("DM2",), 10.0, _GROUP),
    Fault("command-out-of-bounds",
          "Osmosis Control commands 3 m/s straight ahead, three times the top speed",
          (Disturbance(_COMMAND, "corrupt",
                       set_fields={"linear_mps": 3.0, "angular_radps": 0.0}),), ("DM3",), 10.0,
          _GROUP),
    Fault("localization-not-updated",
          "Localization repeats its last pose for ever",
          (Disturbance(_POSE, "freeze"),), ("DM6",), 10.0, _GROUP),
    Fault("prohibited-area",
          "Localization drifts north by 0.25 m/s: the controller leads the robot into the grass "
          "while all looks healthy to it",
          (Disturbance(_POSE, "corrupt", ramp_fields={"y_m": 0.25}),), ("DM1",), 20.0, _GROUP),
    Fault("wrong-graph",
          "Graph Planner gives a way straight to the goal, along an edge that does not exist",
          (Disturbance(topics.ROUTE.key, "corrupt", keep_ends=("waypoints",)),), ("DM1",), 30.0,
          _GROUP),
)}
"""The faults that the paper injects, other than crashes."""

SENSOR_FAULTS: Mapping[str, Fault] = {fault.name: fault for fault in sensor_faults()}
"""The faults of the sensors."""

CATALOGUE: Mapping[str, Fault] = {**PAPER_FAULTS, **SENSOR_FAULTS}
"""All faults with a name of their own; `MODE:TOPIC` comes on top (`topic_faults`)."""


def find_fault(name: str, seed: int = 0, known: Sequence[Topic[Any]] = topics.ALL) -> Fault:
    """Return a fault by name: one of the catalogue, or `MODE:TOPIC`.

    Args:
        name: e.g. `command-not-updated`, `laser-dropout`, `drop:localization/pose`.
        seed: of all that is random in it.
        known: all topics of the system, see `system_topics`.

    Raises:
        UnknownFaultError: there is none of this name.
    """
    if name in CATALOGUE:
        return CATALOGUE[name].varied(seed=seed)
    mode, colon, key = name.partition(":")
    if colon:
        return topic_fault(mode, key, seed, known)
    if name in LEFT_OUT:
        raise UnknownFaultError(f"no fault {name!r}: {LEFT_OUT[name]}")
    near = difflib.get_close_matches(name, CATALOGUE, 1)
    hint = f"did you mean {near[0]}? " if near else ""
    raise UnknownFaultError(
        f"unknown fault {name!r}; {hint}`rampart inject --list` lists the known ones")
