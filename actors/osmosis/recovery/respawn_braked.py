"""RM7: restart the Safety Pilot while the brake is engaged.

The node that commands the wheels is wrong, and no other node does until its successor has settled.
So this recovery uses the brake, like the emergency stop, but releases it by itself: the new Safety
Pilot stops the robot until it has all orders.

It does not claim the brakes, since an emergency stop must not wait. The base brakes while any
source holds the brake (`topics.BRAKE`).
"""

from __future__ import annotations

from rampart.actors.ftm.messages import RecoveryCommand, RecoveryPhase
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.messages import BrakeCommand
from rampart.actors.recovery.respawn import Respawn
from rampart.actors.runtime.actor import Context


class RespawnBraked(Respawn):
    """`Respawn` that holds the low-level brake until its nodes run again.

    If they do not, the brake stays engaged until the manager releases this recovery.
    """

    outputs = (*Respawn.outputs, topics.BRAKE)

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        # The previous incarnation may have left the brake engaged.
        self._holds = context.incarnation > 1

    def act(self, command: RecoveryCommand, *, renewed: bool) -> None:
        """Brake, then request the restart."""
        if renewed or self.phase is RecoveryPhase.ACTING:
            self._brake(engaged=True, why=command.reason)
        super().act(command, renewed=renewed)

    def succeed(self, reason: str = "") -> None:
        """Release the brake: the nodes run again."""
        self._brake(engaged=False, why="")
        super().succeed(reason)

    def let_go(self) -> None:
        """Release the brake, whether the nodes run or not."""
        self._brake(engaged=False, why="")
        super().let_go()

    def stay_idle(self) -> None:
        """Release a brake that the previous incarnation may have left engaged."""
        self._brake(engaged=False, why="")

    def repeat(self) -> None:
        """Repeat an unanswered request, and the order to the brake while it is held."""
        super().repeat()
        if self._holds and self.activated:
            self._brake(engaged=True, why="the safety pilot is being restarted")

    def _brake(self, *, engaged: bool, why: str) -> None:
        if engaged or self._holds:
            self.publish(topics.BRAKE, BrakeCommand(engaged, why))
        self._holds = engaged
