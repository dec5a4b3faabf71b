"""The judge of a system: it observes a run, decides when it is over, and gives a verdict.

A specification names it under `[judge]`; the other keys there are its parameters:

    [judge]
    class = "tug.judge:Deliveries"
    deliveries = 3

A system without a judge can be run and disturbed as well. Its runs have no verdict and no margins.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import msgspec

from rampart.actors.runtime.declaration import Handlers

UNSTABLE = "physics unstable"
"""Context of the diagnostic with which a world ends a run that cannot be judged."""


class Verdict(msgspec.Struct, frozen=True, kw_only=True):
    """Verdict on a run.

    Args:
        success: Whether the task was done.
        safe: Whether the run was always safe; None if no message shows it.
        reasons: Why the run failed or was unsafe; empty if neither.
        margins: Smallest distance from harm, by the names in `Judge.margins`; None where nothing
            was measured.
        severity: Severity of an unsafe run, larger is worse; 0 for a safe run.
        unsafe_s: Time of the first unsafe state, simulated seconds.
        narrowest_s: Time of the smallest margin, simulated seconds.
    """

    success: bool
    safe: bool | None
    reasons: tuple[str, ...] = ()
    margins: dict[str, float | None] = {}
    severity: float = 0.0
    unsafe_s: float | None = None
    narrowest_s: float | None = None


class Judge(Handlers):
    """Base of every judge. Methods marked with `on(TOPIC)` take `(message, header)`.

    A judge is outside of the system: no fault is injected into its inputs, and it publishes
    nothing. It may subscribe to the ground truth of a world.

    Class attributes:
        Parameters: Parameters in the specification.
        margins: Heading in reports of each margin, by name.
        margin_unit: Unit of all margins.
        exact_below: A margin from this value on may be a lower bound; None if all are exact.
    """

    class Parameters(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
        """No parameters, unless a subclass declares some."""

    margins: ClassVar[Mapping[str, str]] = {}
    margin_unit: ClassVar[str] = "m"
    exact_below: ClassVar[float | None] = None

    def __init__(self, parameters: Any = None) -> None:
        self.parameters = self.Parameters() if parameters is None else parameters

    def over(self, now_s: float) -> str | None:
        """Return why the run is over, or None while it continues; called repeatedly."""
        del now_s
        return None

    def verdict(self) -> Verdict:
        """Return the verdict on the run so far."""
        raise NotImplementedError
