"""RM7: respawn the Safety Pilot, with the brake held meanwhile.

Whoever commands the wheels is wrong, and until its successor has settled nobody else does. So this
recovery goes past it as the emergency stop does, but lets go by itself: when the new Safety Pilot
lives, it is that which stops the robot until it knows all orders.

It does not claim the brakes, since an emergency stop must have nobody to wait for. Each may hold
the brake and let go of it: the base brakes as long as anybody holds it (`topics.BRAKE`).
"""

from __future__ import annotations

from rampart.actors.ftm.messages import RecoveryCommand, RecoveryPhase
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.messages import BrakeCommand
from rampart.actors.recovery.respawn import Respawn
from rampart.actors.runtime.actor import Context


class RespawnBraked(Respawn):
    """`Respawn` that holds the low-level brake from its order until its nodes are back.

    If the nodes do not come back the brake stays engaged until the manager releases this recovery.
    """

    outputs = (*Respawn.outputs, topics.BRAKE)

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        # An earlier life may have died with the brake held.
        self._holds = context.incarnation > 1

    def act(self, command: RecoveryCommand, *, renewed: bool) -> None:
        """Brake, then ask for the nodes."""
        if renewed or self.phase is RecoveryPhase.ACTING:
            self._brake(engaged=True, why=command.reason)
        super().act(command, renewed=renewed)

    def succeed(self, reason: str = "") -> None:
        """Release the brake: the nodes are back."""
        self._brake(engaged=False, why="")
        super().succeed(reason)

    def let_go(self) -> None:
        """Release the brake, whether the nodes are back or not."""
        self._brake(engaged=False, why="")
        super().let_go()

    def stay_idle(self) -> None:
        """Release a brake that an earlier life of this module may have left behind."""
        self._brake(engaged=False, why="")

    def repeat(self) -> None:
        """Repeat what is not answered, and the brake while it is held."""
        super().repeat()
        if self._holds and self.activated:
            self._brake(engaged=True, why="the safety pilot is being respawned")

    def _brake(self, *, engaged: bool, why: str) -> None:
        if engaged or self._holds:
            self.publish(topics.BRAKE, BrakeCommand(engaged, why))
        self._holds = engaged
