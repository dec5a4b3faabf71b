"""RM8: reduced speed.

A robot with weak motors or brakes is safe at a lower speed: a weak motor follows below its reduced
no-load speed, and a stop needs less room. The mission continues in a degraded mode.
"""

from __future__ import annotations

from rampart.actors.osmosis.messages import PilotMode, PilotStatus
from rampart.actors.osmosis.recovery.controlled_stop import PilotRecovery
from rampart.actors.runtime.actor import Context, Header
from rampart.manager.spec.tables import Positive


class ReducedSpeed(PilotRecovery):
    """The Safety Pilot limits the speed of all commands."""

    class Parameters(PilotRecovery.Parameters, frozen=True):
        """Parameters.

        Attributes:
            top_speed_mps: the speed limit.
        """

        top_speed_mps: Positive = 0.5

    parameters: Parameters
    mode = PilotMode.AUTO

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self.top_speed_mps = self.parameters.top_speed_mps

    def pilot_status(self, message: PilotStatus, header: Header) -> None:
        """Take the speed limit of the Safety Pilot."""
        in_force = 0.0 < message.top_speed_mps <= self.top_speed_mps
        self.confirm(in_force=in_force, stamp_s=header.stamp,
                     reason=f"at most {message.top_speed_mps:g} m/s" if in_force
                     else "the safety pilot does not limit the speed")
