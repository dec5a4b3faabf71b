"""Missions and orders that the page sends to the Mission Manager, and their outcome. Pure.

**Missions.** A request is repeated until the Mission Manager shows the mission, since it may start
later or be restarting. It is never sent again afterwards. In the paper a Mission Manager that
crashes loses its mission; a repeated request would drive the robot a second time without an order.
For the same reason, an HMI that restarts during a run does not send the run's first mission: it
does not know what its predecessor received.

**Orders.** The Mission Manager publishes with each status which orders it would obey. The page
offers only these; it refuses others with the reason before they reach the bus. It repeats an order
as the identical message until the Mission Manager answers.
"""

from __future__ import annotations

import math

from rampart.actors.ftm import messages as fm
from rampart.actors.operator.requests import REQUESTS, Name, Pending, RefusedError, Request
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis.control.mission.mission_state import first_id
from rampart.actors.web.visitors import Role

RESPAWN_WINDOW_S = 8.0
"""Simulated time up to which a restarted HMI sends the first mission: its predecessor may have died
before it could."""

MISSION_GIVE_UP_S = 10.0
"""Time after which a mission that was not accepted is withdrawn."""

ORDER_GIVE_UP_S = 5.0
"""Simulated time after which an unanswered order is withdrawn."""

START_ANYWAY_S = 5.0
"""Simulated time after which the first mission is sent although a node does not run: missing nodes
are a matter of the fault tolerance."""

_BUSY = (m.MissionPhase.RUNNING, m.MissionPhase.PAUSED, m.MissionPhase.RETURNING)


def all_run(table: fm.NodeTable | None) -> bool:
    """Whether all nodes run, as far as the supervisor has reported."""
    return table is not None and all(
        row.state is fm.NodeState.RUNNING for row in table.nodes)


def system_is_up(table: fm.NodeTable | None, now_s: float) -> bool:
    """Whether a mission may be sent: simulated time has begun and all nodes run."""
    return now_s > START_ANYWAY_S or (now_s >= 0 and all_run(table))


class Submission(Pending[m.MissionRequest]):
    """The pending mission request.

    Args:
        run_id: id of this run; mission ids are derived from it.
        incarnation: incarnation of the page's node, counted from 1.
        now_s: simulated time at which this incarnation began.
        first: mission to send at the start of the run; None for none.
    """

    def __init__(self, run_id: str, incarnation: int, now_s: float, first: m.MissionRequest | None
                 ) -> None:
        super().__init__(f"{run_id}/{incarnation}",
                         "was not accepted: the Mission Manager does not answer", MISSION_GIVE_UP_S)
        self._status: m.MissionStatus | None = None
        self._first = first is not None and (incarnation == 1 or now_s < RESPAWN_WINDOW_S)
        if first is not None and self._first:
            self.put(f"mission {first.name}", first, math.inf)

    def hear(self, status: m.MissionStatus) -> None:
        """Take the Mission Manager's status; a request that it shows is settled.

        Any mission in the status settles the run's first one.
        """
        self._status = status
        if self.pending is not None and (
                status.mission_id == self.pending.mission_id
                or (self._first and status.mission_id)):
            self.settle()
            self._first = False

    def ask(self, name: str, goals: tuple[m.Goal, ...], now_s: float) -> m.MissionRequest:
        """Make a request of the operator pending.

        Raises:
            RefusedError: another mission runs or is pending.
        """
        mission_id = self.new_id()
        if self._status is not None and self._status.phase in _BUSY:
            raise RefusedError(f"mission {self._status.name} is {self._status.phase.value}")
        return self.put(f"mission {name}", m.MissionRequest(mission_id, name, goals), now_s)


def first_request(run_id: str, name: str, goals: tuple[m.Goal, ...]) -> m.MissionRequest:
    """Return the request for the first mission of a run."""
    return m.MissionRequest(first_id(run_id), name, goals)


NO_REASON = "asked for on the page"


class Orders(Pending[m.MissionOrder]):
    """The pending order.

    Args:
        prefix: prefix of the orders' ids, unique for each incarnation of the node.
        by: sender of the orders.
    """

    def __init__(self, prefix: str, by: str) -> None:
        super().__init__(
            prefix, "was not obeyed: the Mission Manager does not answer", ORDER_GIVE_UP_S)
        self._by = by
        self._status: m.MissionStatus | None = None

    def hear(self, status: m.MissionStatus) -> None:
        """Take the Mission Manager's status."""
        self._status = status

    def give(self, action: m.MissionAction, reason: str, now_s: float) -> m.MissionOrder:
        """Make an order of the operator pending.

        Raises:
            RefusedError: another order is pending, or the Mission Manager would refuse it.
        """
        order = self.new_id()
        if self._status is None:
            raise RefusedError("no status of the Mission Manager was received yet")
        if action not in self._status.orders:
            possible = ", ".join(self._status.orders) or "none"
            raise RefusedError(f"{action.value} is not possible while the mission is "
                               f"{self._status.phase.value}; possible: {possible}")
        return self.put(action.value, m.MissionOrder(
            order, action, " ".join(reason.split()) or NO_REASON, self._by), now_s)

    def answer(self, answer: m.MissionOrderAnswer) -> str:
        """Return the outcome of the pending order, or "" for an answer to another order."""
        if self.pending is None or answer.order != self.pending.order:
            return ""
        action = self.settle()
        return f"{action} obeyed" if answer.accepted else f"{action} refused: {answer.reason}"

class StartRequest(Request, frozen=True, tag="mission"):
    """Start a mission of the airport."""

    role = Role.DRIVE
    name: Name


class OrderRequest(Request, frozen=True, tag="order"):
    """Give an order to the mission under way."""

    role = Role.DRIVE
    action: m.MissionAction
    reason: Name = ""


OSMOSIS_REQUESTS: tuple[type[Request], ...] = (*REQUESTS, StartRequest, OrderRequest)
