"""The operator's orders to a mission: which make sense now, and what became of them. Pure.

Which orders the Mission Manager would obey it says itself, with each status; the page only reads
that off. So it offers what makes sense in the present phase, and an order that does not is
refused here, with the reason, before it reaches the bus. One that does is repeated, as the
identical message, until the Mission Manager answers: it may be down and just coming back.
"""

from __future__ import annotations

from rampart.actors.operator.requests import Pending, RefusedError
from rampart.actors.osmosis import messages as m

GIVE_UP_S = 5.0
"""Simulated seconds after which an order that nobody answers is withdrawn."""

NO_REASON = "asked for on the page"


class Orders(Pending[m.MissionOrder]):
    """The one order that waits for its answer.

    Args:
        prefix: of the orders' ids; another one for each incarnation of the node.
        by: who asks.
    """

    def __init__(self, prefix: str, by: str) -> None:
        super().__init__(prefix, "was not obeyed: the Mission Manager does not answer", GIVE_UP_S)
        self._by = by
        self._status: m.MissionStatus | None = None

    def hear(self, status: m.MissionStatus) -> None:
        """Take note of the Mission Manager's status."""
        self._status = status

    def give(self, action: m.MissionAction, reason: str, now_s: float) -> m.MissionOrder:
        """Make an order of the operator pending.

        Raises:
            RefusedError: another one waits for its answer, or it makes no sense now.
        """
        order = self.new_id()
        if self._status is None:
            raise RefusedError("the Mission Manager was not heard yet")
        if action not in self._status.orders:
            possible = ", ".join(self._status.orders) or "none"
            raise RefusedError(f"{action.value} makes no sense while the mission is "
                               f"{self._status.phase.value}; possible: {possible}")
        return self.put(action.value, m.MissionOrder(
            order, action, " ".join(reason.split()) or NO_REASON, self._by), now_s)

    def answer(self, answer: m.MissionOrderAnswer) -> str:
        """Return what the answer to the pending order means, "" if it is another's."""
        if self.pending is None or answer.order != self.pending.order:
            return ""
        action = self.settle()
        return f"{action} obeyed" if answer.accepted else f"{action} refused: {answer.reason}"
