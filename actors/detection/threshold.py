"""`Threshold`: a number in a message is too large, too small, or not finite."""

from __future__ import annotations

import math
from typing import Any

from rampart.actors.detection.finding import Sustained
from rampart.actors.detection.module import DetectionModule
from rampart.actors.runtime.actor import Context, Header
from rampart.actors.runtime.parameters import FieldName, Suspects
from rampart.manager.spec.tables import NonNegative


class Threshold(DetectionModule):
    """Active when a field has been outside its limits for long enough."""

    class Parameters(DetectionModule.Parameters, frozen=True, kw_only=True):
        """A number and its limits.

        Attributes:
            value: the number, as "topic:field".
            above: highest permitted number.
            below: lowest permitted number.
            absolute: whether to ignore its sign.
            for_s: how long it has to be outside, s.
            clear_s: how long it has to be inside before the module is idle again, s.
            hysteresis: how far inside it then has to be.
            suspects: nodes to be respawned while it is active; none by default.
        """

        value: FieldName
        above: float | None = None
        below: float | None = None
        absolute: bool = False
        for_s: NonNegative = 0.0
        clear_s: NonNegative = 0.2
        hysteresis: NonNegative = 0.0
        suspects: Suspects = ()

        def __post_init__(self) -> None:
            """Refuse parameters without limits, and limits that permit nothing."""
            if self.above is None and self.below is None:
                raise ValueError("above: missing; give above, below or both")
            if (self.above is not None and self.below is not None
                    and not self.below + 2 * self.hysteresis < self.above):
                raise ValueError("below: must be smaller than above by more than twice the "
                                 "hysteresis")

    parameters: Parameters

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        chosen = self.parameters
        self.monitor = self.judged_by(Sustained(
            chosen.for_s, chosen.clear_s, self.known_after_s(chosen.for_s + chosen.clear_s)))
        self._out = False
        self.hear_field(chosen.value, self.heard)

    def heard(self, value: Any, header: Header) -> None:
        """Note a number."""
        if value is None:
            return
        number = abs(value) if self.parameters.absolute else value
        why = self._problem(number)
        self._out = bool(why)
        self.monitor.accused = self.accused(self.parameters.suspects, header)
        self.monitor.note(f"{self.parameters.value}: {why}" if why else "", self.clock.now())
        self.follow()

    def _problem(self, number: float) -> str:
        limits = self.parameters
        margin = limits.hysteresis if self._out else 0.0
        if not math.isfinite(number):
            return f"{number} is not finite"
        if limits.above is not None and number > limits.above - margin:
            return f"{number:g} is above {limits.above:g}"
        if limits.below is not None and number < limits.below + margin:
            return f"{number:g} is below {limits.below:g}"
        return ""
