"""What a fault on topics is: disturbances of single topics, under a name, for a while.

A disturbance acts in the process that publishes its topic (see `rampart.actors.runtime.injection`),
so what the rest of the system sees is what a real failure of that node would show.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from msgspec import Struct
from msgspec.structs import asdict, replace

from rampart.actors.bus.messages import Injection


class UnknownFaultError(ValueError):
    """No fault of this name; the message is one line and says where the known ones are."""


class Disturbance(Struct, frozen=True):
    """What happens to one topic; the fields are those of `Injection`."""

    topic: str
    mode: str
    delay_s: float = 0.0
    set_fields: Mapping[str, Any] = {}
    ramp_fields: Mapping[str, float] = {}
    keep_ends: tuple[str, ...] = ()
    add_fields: Mapping[str, float] = {}
    noise_fields: Mapping[str, float] = {}
    share: float = 1.0
    on_s: float = 0.0
    off_s: float = 0.0
    seed: int = 0
    stamp_s: float = 0.0

    def order(self, injection: str, duration_s: float) -> Injection:
        """Return the message that orders it, under an id, for simulated seconds."""
        return Injection(injection, duration_s=duration_s, **asdict(self))


class Fault(Struct, frozen=True):
    """A named fault.

    Args:
        name: as typed by the user.
        title: one line for people.
        disturbances: what it does.
        detected_by: detection modules that should see it; empty if none is meant to.
        duration_s: how long it lasts unless told otherwise, simulated seconds; infinity for ever.
        group: part of the catalogue that it belongs to.
    """

    name: str
    title: str
    disturbances: tuple[Disturbance, ...]
    detected_by: tuple[str, ...]
    duration_s: float
    group: str = ""

    def orders(self, injection: str, duration_s: float | None = None) -> tuple[Injection, ...]:
        """Return the injections that make up the fault.

        Args:
            injection: id; several disturbances get "ID.1", "ID.2" and so on.
            duration_s: simulated seconds, infinity for permanent; the fault's own if None.
        """
        lasts_s = self.duration_s if duration_s is None else duration_s
        several = len(self.disturbances) > 1
        return tuple(d.order(f"{injection}.{i}" if several else injection, lasts_s)
                     for i, d in enumerate(self.disturbances, start=1))

    def varied(self, *, share: float | None = None, on_s: float | None = None,
               off_s: float | None = None, seed: int | None = None) -> Fault:
        """Return the fault for a share of the messages, intermittent, or with other chance.

        Args:
            share: probability that a message is affected.
            on_s: how long an intermittent fault is in force, simulated seconds.
            off_s: how long it is away in between, simulated seconds.
            seed: of all that is random; each disturbance gets one of its own. None keeps.
        """
        given = {"share": share, "on_s": on_s, "off_s": off_s}
        changed = {name: value for name, value in given.items() if value is not None}
        return replace(self, disturbances=tuple(
            replace(d, **changed, seed=d.seed if seed is None else seed + i)
            for i, d in enumerate(self.disturbances)))
