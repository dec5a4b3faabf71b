"""RM1: emergency stop, at low level (paper, table II)."""

from __future__ import annotations

from rampart.actors.ftm.messages import RecoveryCommand
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.messages import BaseStatus, BrakeCommand
from rampart.actors.recovery.holding import HeldOrder, HeldRecovery
from rampart.actors.runtime.actor import Context, Header, on

_FOUND_ENGAGED = "the brake was found engaged"
_PATIENCE_S = 0.5
"""How long a respawned module waits to see the brake before it says that it is idle."""


class EmergencyStop(HeldRecovery):
    """Engages the brake of the Summit XL layer, past the Safety Pilot and all control nodes.

    The brake itself remembers. When this module and the manager die in the same moment, the
    brake is all that knows of the emergency stop; so a respawned module looks at it before it
    says anything, and if it is engaged, counts as activated. The manager then adopts it.
    """

    outputs = (*HeldRecovery.outputs, topics.BRAKE)

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        # If the brake is found engaged this module is not idle, so it inherits nothing to end.
        self.order = HeldOrder(self, self._brake, inherits=False)
        self._looking = context.incarnation > 1

    def on_start(self) -> None:
        """Say at once that it is there, unless it has to look at the brake first."""
        super().on_start()
        if self._looking:
            self.call_later(_PATIENCE_S, self._stop_looking)

    def _stop_looking(self) -> None:
        if self._looking:
            self._looking = False
            self._tell_change()

    def _brake(self, engaged: bool, why: str) -> None:
        self.publish(topics.BRAKE, BrakeCommand(engaged, why))

    def act(self, command: RecoveryCommand, *, renewed: bool) -> None:
        """Engage the brake."""
        self._looking = False
        super().act(command, renewed=renewed)

    @on(topics.BASE_STATUS)
    def base_status(self, message: BaseStatus, header: Header) -> None:
        """See whether the brake is engaged."""
        if self._looking:
            self._looking = False
            if message.brake_engaged:
                self.order.why = _FOUND_ENGAGED
                self.ordered_s = header.stamp
                self.resume(_FOUND_ENGAGED)
            else:
                self._tell_change()
        self.order.status(in_force=message.brake_engaged, stamp_s=header.stamp,
                           reason="brake engaged" if message.brake_engaged else "brake not engaged")

    def _tell(self) -> None:
        if not self._looking:
            super()._tell()
