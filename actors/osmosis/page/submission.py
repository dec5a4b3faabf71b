"""When the HMI sends a mission, and when it must keep quiet. Pure.

A request is repeated until the Mission Manager shows that it took the mission, because the
Mission Manager may start later or be down. Once taken, it is never sent again: in the paper a
Mission Manager that crashes loses its mission, and an HMI that sent it anew would drive the robot
round the airport a second time without anyone having asked for it. For the same reason an HMI
that was respawned in the middle of a run, and so cannot know what its predecessor saw, does not
send the run's first mission at all.
"""

from __future__ import annotations

from rampart.actors.ftm import messages as fm
from rampart.actors.osmosis import messages as m

RESPAWN_WINDOW_S = 8.0
"""A respawned HMI still sends the first mission this early in the run (simulated time): its
predecessor may have died before it was heard."""

REPEAT_S = 0.5
"""Simulated seconds between repetitions of a request."""

GIVE_UP_S = 10.0
"""A mission asked for on the page is withdrawn when it was not taken for so long."""

START_ANYWAY_S = 5.0
"""A node that does not come up does not hold the mission back longer (simulated time): what is
missing is the fault tolerance's business, not the HMI's."""

_BUSY = (m.MissionPhase.RUNNING, m.MissionPhase.PAUSED, m.MissionPhase.RETURNING)


class BusyError(ValueError):
    """A mission cannot be started now; the text says why."""


def system_is_up(table: fm.NodeTable | None, now_s: float) -> bool:
    """Whether a mission may be sent: simulated time has begun, and all known nodes run."""
    if now_s < 0 or table is None:
        return now_s >= 0
    return now_s > START_ANYWAY_S or all(
        row.state is fm.NodeState.RUNNING for row in table.nodes)


class Submission:
    """The one mission request that waits to be taken.

    Args:
        run_id: of this run; mission ids are derived from it.
        incarnation: which life of the HMI this is, counted from 1.
        now_s: simulated time at which this life began.
        first: mission to send at the start of the run, None for none.
    """

    def __init__(
        self, run_id: str, incarnation: int, now_s: float, first: m.MissionRequest | None
    ) -> None:
        self._run_id = run_id
        self._incarnation = incarnation
        self._asked = 0
        self._status: m.MissionStatus | None = None
        self._give_up_s: float | None = None
        self._pending: m.MissionRequest | None = None
        if first is not None and (incarnation == 1 or now_s < RESPAWN_WINDOW_S):
            self._pending = first

    @property
    def pending(self) -> m.MissionRequest | None:
        """The request to be sent now and every `REPEAT_S`, or None."""
        return self._pending

    def hear(self, status: m.MissionStatus) -> None:
        """Take note of the Mission Manager's status; a request it shows is settled.

        So is the run's first mission by any other: whoever has one was not waiting for it.
        """
        self._status = status
        if self._pending is not None and (
                status.mission_id == self._pending.mission_id
                or (self._give_up_s is None and status.mission_id)):
            self._pending = None
            self._give_up_s = None

    def ask(self, name: str, goals: tuple[m.Goal, ...], now_s: float) -> m.MissionRequest:
        """Make a request of the operator pending.

        Raises:
            BusyError: another mission runs or waits to be taken.
        """
        if self._pending is not None:
            raise BusyError(f"mission {self._pending.name} waits to be taken")
        if self._status is not None and self._status.phase in _BUSY:
            raise BusyError(f"mission {self._status.name} is {self._status.phase.value}")
        self._asked += 1
        mission_id = f"{self._run_id}/{self._incarnation}.{self._asked}"
        self._pending = m.MissionRequest(mission_id, name, goals)
        self._give_up_s = now_s + GIVE_UP_S
        return self._pending

    def expire(self, now_s: float) -> m.MissionRequest | None:
        """Withdraw a request of the operator that nobody takes, and return it."""
        if self._pending is None or self._give_up_s is None or now_s < self._give_up_s:
            return None
        withdrawn, self._pending, self._give_up_s = self._pending, None, None
        return withdrawn


def first_request(run_id: str, name: str, goals: tuple[m.Goal, ...]) -> m.MissionRequest:
    """Return the request for the mission that a run starts with."""
    return m.MissionRequest(f"{run_id}/first", name, goals)
