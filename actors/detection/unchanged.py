"""`Unchanged`: a value never changes although it should: a frozen sensor, a node in a rut."""

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
    """Active from a message with the value of the last `for_s`, until that changes again.

    It is judged when a message comes: a sender that stops is not unchanged but silent. A new
    process of the sender is given `for_s` of its own.

    Args:
        what: is watched, for the reason.
        for_s: how long it has to be the same, simulated seconds.
        clear_s: how long it then has to go on changing.
        within: how far two numbers may be apart and are the same.
        may_last: values that may be said for any time.
        known_after_s: when idle may be claimed without anything heard; -inf for at once.

    Attributes:
        accused: whom to name when it becomes active; up to the owner.
    """

    def __init__(self, what: str, for_s: float, clear_s: float = 0.0, *, within: float = 0.0,
                 may_last: tuple[Any, ...] = (), known_after_s: float = -math.inf) -> None:
        super().__init__(0.0, clear_s, known_after_s)
        self._what, self._for_s = what, for_s
        self._within, self._may_last = within, may_last
        self._value: Any = _NOTHING
        self._since_s = math.inf

    def heard(self, value: Any, now_s: float, *, renewed: bool = False) -> None:
        """Take note of a value.

        Args:
            value: a number, a text or a truth value.
            now_s: now.
            renewed: whether another process of its sender published the value before.
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
        self._known_after_s = now_s + self._for_s  # of one value and then silence nothing follows

    def _is_the_same(self, value: Any) -> bool:
        before = self._value
        if before is _NOTHING:
            return False
        nan = all(isinstance(one, float) and math.isnan(one) for one in (before, value))
        return nan or value == before or apart(before, value, angle=False) <= self._within


class Unchanged(DetectionModule):
    """Active while a field has said the same for too long: what is measured has some noise."""

    class Parameters(DetectionModule.Parameters, frozen=True, kw_only=True):
        """Which field, and for how long.

        Attributes:
            value: the field, as "topic:field".
            for_s: how long it has to be the same, s; some periods of its topic.
            clear_s: how long it has to go on changing before the module is idle again, s.
            within: how far two numbers may be apart and still count as the same.
            may_last: values that may last, as that of a rotor which does not turn.
            suspects: names of nodes to be respawned when it is active; none by default.
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
        said = self.parameters
        self.monitor = self.judged_by(UnchangedMonitor(
            said.value, said.for_s, said.clear_s, within=said.within, may_last=said.may_last,
            known_after_s=self.known_after_s(said.for_s)))
        self.hear_field(said.value, self.heard)

    def heard(self, value: Any, header: Header) -> None:
        """Take note of a value."""
        if value is None:
            return
        before = self._senders.get(header.source, header.incarnation)
        self.monitor.accused = self.accused(self.parameters.suspects, header)
        self.monitor.heard(value, self.clock.now(), renewed=before != header.incarnation)
        self.follow()
