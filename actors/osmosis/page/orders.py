"""The operator's orders to a mission: which make sense now, and what became of them. Pure.

Which orders the Mission Manager would obey it says itself, with each status; the HMI only reads
that off. So the page offers what makes sense in the present phase, and an order that does not is
refused here, with the reason, before it reaches the bus. One that does is repeated, as the
identical message, until the Mission Manager answers: it may be down and just coming back.
"""

from __future__ import annotations

from rampart.actors.osmosis import messages as m

GIVE_UP_S = 5.0
"""Simulated seconds after which an order that nobody answers is withdrawn."""

NO_REASON = "asked for on the page"


class NoSenseError(ValueError):
    """An order cannot be given now; the text says why."""


class Orders:
    """The one order that waits for its answer.

    Args:
        prefix: of the orders' ids; another one for each life of the HMI.
        by: who asks.
    """

    def __init__(self, prefix: str, by: str) -> None:
        self._prefix = prefix
        self._by = by
        self._given = 0
        self._status: m.MissionStatus | None = None
        self._pending: m.MissionOrder | None = None
        self._give_up_s = 0.0

    @property
    def pending(self) -> m.MissionOrder | None:
        """The order to be sent now and again until it is answered, or None."""
        return self._pending

    def hear(self, status: m.MissionStatus) -> None:
        """Take note of the Mission Manager's status."""
        self._status = status

    def give(self, action: m.MissionAction, reason: str, now_s: float) -> m.MissionOrder:
        """Make an order of the operator pending.

        Raises:
            NoSenseError: another one waits for its answer, or it makes no sense now.
        """
        if self._pending is not None:
            raise NoSenseError(f"{self._pending.action.value} waits for its answer")
        if self._status is None:
            raise NoSenseError("the Mission Manager was not heard yet")
        if action not in self._status.orders:
            possible = ", ".join(self._status.orders) or "none"
            raise NoSenseError(f"{action.value} makes no sense while the mission is "
                               f"{self._status.phase.value}; possible: {possible}")
        self._given += 1
        self._pending = m.MissionOrder(f"{self._prefix}.{self._given}", action,
                                       " ".join(reason.split()) or NO_REASON, self._by)
        self._give_up_s = now_s + GIVE_UP_S
        return self._pending

    def answer(self, answer: m.MissionOrderAnswer) -> str:
        """Return what the answer to the pending order means, "" if it is another's."""
        if self._pending is None or answer.order != self._pending.order:
            return ""
        action, self._pending = self._pending.action.value, None
        return f"{action} obeyed" if answer.accepted else f"{action} refused: {answer.reason}"

    def expire(self, now_s: float) -> str:
        """Withdraw an order that nobody answers, and return what to tell; "" if there is none."""
        if self._pending is None or now_s < self._give_up_s:
            return ""
        action, self._pending = self._pending.action.value, None
        return f"{action} was not obeyed: the Mission Manager does not answer"
