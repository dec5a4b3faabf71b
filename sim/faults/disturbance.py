"""Faults on topics: named disturbances of single topics for some time.

A disturbance acts in the process that publishes its topic (`rampart.actors.runtime.injection`), so
the rest of the system receives what it would receive after a real failure of that node.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from msgspec import Struct
from msgspec.structs import asdict, replace

from rampart.actors.bus.messages import Injection


class UnknownFaultError(ValueError):
    """Unknown name of a fault; the message is one line, with a hint to the known ones."""


class Disturbance(Struct, frozen=True):
    """Disturbance of one topic; the fields are those of `Injection`."""

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
        """Return the message that orders it, with an id and a duration in simulated seconds."""
        return Injection(injection, duration_s=duration_s, **asdict(self))


class Fault(Struct, frozen=True):
    """A named fault.

    Args:
        name: As typed by the user.
        title: One line for people.
        disturbances: Its effects.
        detected_by: Detection modules that should detect it; empty if none should.
        duration_s: Default duration, simulated seconds; infinity for permanent.
        group: Its part of the catalogue.
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
            injection: Id; several disturbances get "ID.1", "ID.2" and so on.
            duration_s: Simulated seconds, infinity for permanent; None for the default.
        """
        lasts_s = self.duration_s if duration_s is None else duration_s
        several = len(self.disturbances) > 1
        return tuple(d.order(f"{injection}.{i}" if several else injection, lasts_s)
                     for i, d in enumerate(self.disturbances, start=1))

    def varied(self, *, share: float | None = None, on_s: float | None = None,
               off_s: float | None = None, seed: int | None = None) -> Fault:
        """Return the fault for a share of the messages, intermittent, or with another seed.

        Args:
            share: Probability that a message is affected.
            on_s: How long an intermittent fault is in force, simulated seconds.
            off_s: How long it is absent in between, simulated seconds.
            seed: Of the first disturbance; the others get the next ones. None keeps the seeds.
        """
        given = {"share": share, "on_s": on_s, "off_s": off_s}
        changed = {name: value for name, value in given.items() if value is not None}
        return replace(self, disturbances=tuple(
            replace(d, **changed, seed=d.seed if seed is None else seed + i)
            for i, d in enumerate(self.disturbances)))
