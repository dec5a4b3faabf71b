"""RM2: controlled stop (paper, table II): speed 0, with the control loop alive."""

from __future__ import annotations

from rampart.actors.osmosis import topics
from rampart.actors.osmosis.messages import PilotMode, PilotOrder, PilotStatus
from rampart.actors.recovery.holding import HeldOrder, HeldRecovery
from rampart.actors.runtime.actor import Context, Header, on


class PilotRecovery(HeldRecovery):
    """Orders the Safety Pilot into a mode: base of RM2, RM5 and RM8.

    Class attributes:
        mode: what is ordered.
        confirming: modes of the Safety Pilot by which the order is fulfilled.
        top_speed_mps: bound that is ordered with it, 0 for none.
    """

    outputs = (*HeldRecovery.outputs, topics.PILOT_ORDER)
    mode = PilotMode.STOP
    confirming: tuple[PilotMode, ...] = (PilotMode.STOP,)
    top_speed_mps = 0.0

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self.order = HeldOrder(self, self._give, inherits=context.incarnation > 1)

    def _give(self, engaged: bool, why: str) -> None:
        self.publish(topics.PILOT_ORDER, PilotOrder(
            engaged, self.mode, why, self.top_speed_mps if engaged else 0.0))

    @on(topics.PILOT_STATUS)
    def pilot_status(self, message: PilotStatus, header: Header) -> None:
        """See which mode the Safety Pilot is in."""
        self.order.status(in_force=message.mode in self.confirming,
                          reason=f"safety pilot in mode {message.mode}", stamp_s=header.stamp)


class ControlledStop(PilotRecovery):
    """The Safety Pilot commands speed 0, whatever it is told by others."""
