"""The judge of a system: hears a run, says when it is over and what it was worth.

A specification names one under `[judge]`; the other keys there are its parameters:

    [judge]
    class = "tug.judge:Deliveries"
    deliveries = 3

A system without a judge can be run and disturbed as well; of its runs no success, safety or margin
is known.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import msgspec

from rampart.actors.runtime.declaration import Handlers

UNSTABLE = "physics unstable"
"""Context of the diagnostic by which a world ends a run that nobody can judge."""


class Verdict(msgspec.Struct, frozen=True, kw_only=True):
    """What a run was worth.

    Args:
        success: whether its task was done.
        safe: whether it was safe all the time; None if nothing was heard to know it by.
        reasons: why not, in words; empty if all is well.
        margins: how far from harm it was at its worst, by the names in `Judge.margins`; None where
            there was nothing to measure.
        severity: how bad an unsafe run was: the larger, the worse; 0 for a safe one.
        unsafe_s: when it first became unsafe, simulated seconds.
        narrowest_s: when the smallest margin was measured.
    """

    success: bool
    safe: bool | None
    reasons: tuple[str, ...] = ()
    margins: dict[str, float | None] = {}
    severity: float = 0.0
    unsafe_s: float | None = None
    narrowest_s: float | None = None


class Judge(Handlers):
    """Base of every judge. Methods marked with `on(TOPIC)` hear messages: `heard(message, header)`.

    A judge is outside of the system: no fault is injected into what it hears, and nothing in the
    system hears it. It hears the truth where a world publishes it.

    Class attributes:
        Parameters: what the specification may say of it.
        margins: how far from harm a run was: names, and how they are headed in a report.
        margin_unit: of all of them.
        exact_below: above it a margin may be a lower bound; None if all are exact.
    """

    class Parameters(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
        """None, unless a subclass declares some."""

    margins: ClassVar[Mapping[str, str]] = {}
    margin_unit: ClassVar[str] = "m"
    exact_below: ClassVar[float | None] = None

    def __init__(self, parameters: Any = None) -> None:
        self.parameters = self.Parameters() if parameters is None else parameters

    def over(self, now_s: float) -> str | None:
        """Return why the run is over, or None while it goes on; asked now and then."""
        del now_s
        return None

    def verdict(self) -> Verdict:
        """Return what the run was worth so far."""
        raise NotImplementedError
