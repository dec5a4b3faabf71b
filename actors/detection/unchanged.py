"""`Unchanged`: a value does not change although it should, as of a frozen sensor."""

from __future__ import annotations

import math
from typing import Any

from rampart.actors.detection.disagreement import apart
from rampart.actors.detection.finding import Sustained
from rampart.actors.detection.module import DetectionModule
from rampart.actors.runtime.actor import Context, Header
from rampart.actors.runtime.parameters import FieldName, Suspects
from rampart.manager.spec.tables import NonNegative, Positive

_NOTHING = object()


class UnchangedMonitor(Sustained):
    """Active when the value has been the same for `for_s`, until it changes.

    It decides when a message arrives: a sender that stops is silent, not unchanged. For a new
    process of the sender, or of a suspect, the time starts again.

    Args:
        what: Name of the field, for the reason.
        for_s: How long the value has to be the same, simulated seconds.
        clear_s: How long it then has to keep changing.
        within: Greatest distance of numbers that count as the same.
        may_last: Values that may last for any time.
        known_after_s: When to report idle without any input; -inf for at once.
    """

    def __init__(self, what: str, for_s: float, clear_s: float = 0.0, *, within: float = 0.0,
                 may_last: tuple[Any, ...] = (), known_after_s: float = -math.inf) -> None:
        super().__init__(0.0, clear_s, known_after_s)
        self._what, self._for_s = what, for_s
        self._within, self._may_last = within, may_last
        self._value: Any = _NOTHING
        self._since_s = math.inf

    def heard(self, value: Any, now_s: float, *, renewed: bool = False) -> None:
        """Note a value.

        Args:
            value: A number, text or truth value.
            now_s: Present time.
            renewed: Whether the sender or a suspect was another process before.
        """
        if value in self._may_last or not self._is_the_same(value):
            if self._value is not _NOTHING or value in self._may_last:
                self.note("", now_s)
            self._value, self._since_s = value, now_s
        elif renewed:
            self._since_s = now_s
        elif now_s - self._since_s >= self._for_s - 1e-9:
            self.note(f"{self._what} is {self._value} all the time", now_s)
            self.nodes = self.accused
        self._known_after_s = now_s + self._for_s  # one value and then silence show nothing

    def _is_the_same(self, value: Any) -> bool:
        before = self._value
        if before is _NOTHING:
            return False
        nan = all(isinstance(each, float) and math.isnan(each) for each in (before, value))
        return nan or value == before or apart(before, value, angle=False) <= self._within


class Unchanged(DetectionModule):
    """Active when a field has had the same value for too long; a measured value has some noise."""

    class Parameters(DetectionModule.Parameters, frozen=True, kw_only=True):
        """Field and times.

        Attributes:
            value: the field, as "topic:field".
            for_s: how long it has to be the same, s; some periods of its topic.
            clear_s: how long it has to keep changing before the module is idle again, s.
            within: greatest distance of numbers that count as the same.
            may_last: values that may last, such as 0 of a rotor that does not turn.
            suspects: nodes to be respawned while it is active; none by default.
        """

        value: FieldName
        for_s: Positive
        clear_s: NonNegative = 0.2
        within: NonNegative = 0.0
        may_last: tuple[float | str | bool, ...] = ()
        suspects: Suspects = ()

    parameters: Parameters

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        chosen = self.parameters
        self.monitor = self.judged_by(UnchangedMonitor(
            chosen.value, chosen.for_s, chosen.clear_s, within=chosen.within,
            may_last=chosen.may_last, known_after_s=self.known_after_s(chosen.for_s)))
        self.hear_field(chosen.value, self.heard)

    def heard(self, value: Any, header: Header) -> None:
        """Note a value."""
        if value is None:
            return
        before = self._senders.get(header.source, header.incarnation), self.monitor.accused
        self.monitor.accused = self.accused(self.parameters.suspects, header)
        self.monitor.heard(value, self.clock.now(),
                           renewed=before != (header.incarnation, self.monitor.accused))
        self.follow()
