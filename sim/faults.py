"""The catalogue of faults that can be injected by name.

Each acts on a topic, in the process that publishes it (see `actors.runtime.injection`), so what
the rest of the system sees is what a real failure of that node would show. Crashes are not here:
to crash a node, kill it (`kill-node`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from actors import topics
from actors.messages import Injection


class UnknownFaultError(ValueError):
    """No fault of this name; the message is one line and lists the known ones."""


@dataclass(frozen=True, slots=True)
class Disturbance:
    """What happens to one topic; the fields are those of `Injection`."""

    topic: str
    mode: str
    delay_s: float = 0.0
    set_fields: Mapping[str, Any] = field(default_factory=dict)
    ramp_fields: Mapping[str, float] = field(default_factory=dict)
    keep_ends: tuple[str, ...] = ()

    def order(self, injection: str, duration_s: float) -> Injection:
        """Return the message that orders it, under an id, for simulated seconds."""
        return Injection(injection, self.topic, self.mode, duration_s, self.delay_s,
                         dict(self.set_fields), dict(self.ramp_fields), self.keep_ends)


@dataclass(frozen=True, slots=True)
class Fault:
    """A named fault.

    Args:
        name: as typed by the user.
        title: one line for people.
        disturbances: what it does.
        detected_by: detection modules that should see it.
        duration_s: how long it lasts unless told otherwise, simulated seconds.
    """

    name: str
    title: str
    disturbances: tuple[Disturbance, ...]
    detected_by: tuple[str, ...]
    duration_s: float

    def orders(self, injection: str, duration_s: float | None = None) -> tuple[Injection, ...]:
        """Return the injections that make up the fault.

        Args:
            injection: id; several disturbances get "ID.1", "ID.2" and so on.
            duration_s: simulated seconds; the fault's own duration if None.
        """
        lasts_s = self.duration_s if duration_s is None else duration_s
        if len(self.disturbances) == 1:
            return (self.disturbances[0].order(injection, lasts_s),)
        return tuple(d.order(f"{injection}.{i}", lasts_s)
                     for i, d in enumerate(self.disturbances, start=1))


_COMMAND = topics.COMMAND.key
_POSE = topics.POSE.key

CATALOGUE: Mapping[str, Fault] = {fault.name: fault for fault in (
    Fault("command-not-updated",
          "Osmosis Control repeats its last velocity command for ever",
          (Disturbance(_COMMAND, "freeze"),), ("DM2",), 10.0),
    Fault("command-out-of-bounds",
          "Osmosis Control commands 3 m/s straight ahead, three times the top speed",
          (Disturbance(_COMMAND, "corrupt",
                       set_fields={"linear_mps": 3.0, "angular_radps": 0.0}),), ("DM3",), 10.0),
    Fault("localization-not-updated",
          "Localization repeats its last pose for ever",
          (Disturbance(_POSE, "freeze"),), ("DM6",), 10.0),
    Fault("prohibited-area",
          "Localization drifts north by 0.25 m/s: the controller leads the robot into the grass "
          "while all looks healthy to it",
          (Disturbance(_POSE, "corrupt", ramp_fields={"y_m": 0.25}),), ("DM1",), 20.0),
    Fault("wrong-graph",
          "Graph Planner gives a way straight to the goal, along an edge that does not exist",
          (Disturbance(topics.ROUTE.key, "corrupt", keep_ends=("waypoints",)),), ("DM1",), 30.0),
)}
"""All named faults."""


def find_fault(name: str) -> Fault:
    """Return a fault by name.

    Raises:
        UnknownFaultError: there is none of this name.
    """
    try:
        return CATALOGUE[name]
    except KeyError:
        raise UnknownFaultError(
            f"unknown fault {name!r}; known: {', '.join(CATALOGUE)}") from None
