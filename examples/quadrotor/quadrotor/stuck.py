"""The one detection module that the engine has no generic one for: a value that never changes."""

from __future__ import annotations

import math
from typing import Any

from rampart import Context, DetectionModule, FieldName, Header, Positive, Suspects


class Stuck(DetectionModule):
    """Active while a field says exactly the same for too long: what is measured has some noise."""

    class Parameters(DetectionModule.Parameters, frozen=True, kw_only=True):
        """Which field.

        Attributes:
            value: of what, as "topic:field".
            for_s: how long it has to be the same, s.
            but: a value that may last, as that of a rotor which does not turn.
            suspects: names of nodes to be respawned when it is active.
        """

        value: FieldName
        for_s: Positive
        but: float | None = None
        suspects: Suspects = ()

    parameters: Parameters

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._last: Any = None
        self._since_s = math.inf
        self.hear_field(self.parameters.value, self.heard)

    def heard(self, value: Any, header: Header) -> None:
        """Compare a value with the one before."""
        said, now_s = self.parameters, self.clock.now()
        if value != self._last or value == said.but:
            self._last, self._since_s = value, now_s
            self.know_idle()
        elif now_s - self._since_s >= said.for_s:
            self.activate(f"{said.value} is {value} all the time",
                          self.accused(said.suspects, header))
