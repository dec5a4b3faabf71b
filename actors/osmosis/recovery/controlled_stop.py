"""RM2: controlled stop (paper, table II): speed 0 while the control loop runs."""

from __future__ import annotations

from rampart.actors.osmosis import topics
from rampart.actors.osmosis.messages import PilotMode, PilotOrder, PilotStatus
from rampart.actors.recovery.holding import HeldRecovery
from rampart.actors.runtime.actor import Header, on


class PilotRecovery(HeldRecovery):
    """Orders the Safety Pilot into a mode: base of RM2, RM5 and RM8.

    Class attributes:
        mode: the ordered mode.
        confirming: modes of the Safety Pilot that fulfil the order.
        top_speed_mps: ordered speed limit; 0 for none.
    """

    outputs = (*HeldRecovery.outputs, topics.PILOT_ORDER)
    mode = PilotMode.STOP
    confirming: tuple[PilotMode, ...] = (PilotMode.STOP,)
    top_speed_mps = 0.0

    def give(self, in_force: bool, why: str) -> None:
        """Order the mode, or end the order."""
        self.publish(topics.PILOT_ORDER, PilotOrder(
            in_force, self.mode, why, self.top_speed_mps if in_force else 0.0))

    @on(topics.PILOT_STATUS)
    def pilot_status(self, message: PilotStatus, header: Header) -> None:
        """Take the mode of the Safety Pilot."""
        self.confirm(in_force=message.mode in self.confirming, stamp_s=header.stamp,
                     reason=f"safety pilot in mode {message.mode}")


class ControlledStop(PilotRecovery):
    """The Safety Pilot commands speed 0, regardless of its inputs."""
