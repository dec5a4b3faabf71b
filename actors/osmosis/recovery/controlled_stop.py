"""RM2: controlled stop (paper, table II): speed 0, with the control loop alive."""

from __future__ import annotations

from rampart.actors.osmosis import topics
from rampart.actors.osmosis.messages import PilotMode, PilotOrder, PilotStatus
from rampart.actors.recovery.holding import HoldingRecovery
from rampart.actors.recovery.module import RecoveryModule
from rampart.actors.runtime.actor import Header, on


class PilotRecovery(HoldingRecovery):
    """Orders the Safety Pilot into a mode: base of RM2 and RM5.

    Class attributes:
        mode: what is ordered.
        confirming: modes of the Safety Pilot by which the order is fulfilled.
    """

    outputs = (*RecoveryModule.outputs, topics.PILOT_ORDER)
    mode = PilotMode.STOP
    confirming: tuple[PilotMode, ...] = (PilotMode.STOP,)

    def give_order(self, *, engaged: bool) -> None:
        """Order the mode, or end the order."""
        self.publish(topics.PILOT_ORDER,
                     PilotOrder(engaged, self.mode, self.why if engaged else ""))

    @on(topics.PILOT_STATUS)
    def pilot_status(self, message: PilotStatus, header: Header) -> None:
        """See which mode the Safety Pilot is in."""
        self.status(in_force=message.mode in self.confirming,
                    reason=f"safety pilot in mode {message.mode}", stamp_s=header.stamp)


class ControlledStop(PilotRecovery):
    """The Safety Pilot commands speed 0, whatever it is told by others."""
