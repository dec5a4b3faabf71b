"""When the HMI sends a mission, and when it must keep quiet. Pure.

A request is repeated until the Mission Manager shows that it took the mission, because the
Mission Manager may start later or be down. Once taken, it is never sent again: in the paper a
Mission Manager that crashes loses its mission, and an HMI that sent it anew would drive the robot
round the airport a second time without anyone having asked for it. For the same reason an HMI
that was respawned in the middle of a run, and so cannot know what its predecessor saw, does not
send the run's first mission at all.
"""

from __future__ import annotations

import math

from rampart.actors.ftm import messages as fm
from rampart.actors.operator.requests import Pending, RefusedError
from rampart.actors.osmosis import messages as m

RESPAWN_WINDOW_S = 8.0
"""A respawned HMI still sends the first mission this early in the run (simulated time): its
predecessor may have died before it was heard."""

GIVE_UP_S = 10.0
"""A mission asked for on the page is withdrawn when it was not taken for so long."""

START_ANYWAY_S = 5.0
"""A node that does not come up does not hold the mission back longer (simulated time): what is
missing is the fault tolerance's business, not the HMI's."""

_BUSY = (m.MissionPhase.RUNNING, m.MissionPhase.PAUSED, m.MissionPhase.RETURNING)


def system_is_up(table: fm.NodeTable | None, now_s: float) -> bool:
    """Whether a mission may be sent: simulated time has begun, and all known nodes run."""
    if now_s < 0 or table is None:
        return now_s >= 0
    return now_s > START_ANYWAY_S or all(row.state is fm.NodeState.RUNNING for row in table.nodes)


class Submission(Pending[m.MissionRequest]):
    """The one mission request that waits to be taken.

    Args:
        run_id: of this run; mission ids are derived from it.
        incarnation: of the page's node, counted from 1.
        now_s: simulated time at which that one began.
        first: mission to send at the start of the run, None for none.
    """

    def __init__(self, run_id: str, incarnation: int, now_s: float, first: m.MissionRequest | None
                 ) -> None:
        super().__init__(f"{run_id}/{incarnation}",
                         "was not taken: the Mission Manager does not answer", GIVE_UP_S)
        self._status: m.MissionStatus | None = None
        self._first = first is not None and (incarnation == 1 or now_s < RESPAWN_WINDOW_S)
        if first is not None and self._first:
            self.put(f"mission {first.name}", first, math.inf)

    def hear(self, status: m.MissionStatus) -> None:
        """Take note of the Mission Manager's status; a request it shows is settled.

        So is the run's first mission by any other: whoever has one was not waiting for it.
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
            RefusedError: another mission runs or waits to be taken.
        """
        mission_id = self.new_id()
        if self._status is not None and self._status.phase in _BUSY:
            raise RefusedError(f"mission {self._status.name} is {self._status.phase.value}")
        return self.put(f"mission {name}", m.MissionRequest(mission_id, name, goals), now_s)


def first_request(run_id: str, name: str, goals: tuple[m.Goal, ...]) -> m.MissionRequest:
    """Return the request for the mission that a run starts with."""
    return m.MissionRequest(f"{run_id}/first", name, goals)
