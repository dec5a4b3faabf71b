"""RM8: go on, but slowly.

A robot whose motors or brakes have lost some of their strength is master of less speed, not of
none: a weak motor keeps up below its reduced no-load speed, and from a lower speed a stop takes
less room. The mission goes on in a degraded mode, and takes longer.
"""

from __future__ import annotations

from rampart.actors.osmosis.messages import PilotMode, PilotStatus
from rampart.actors.osmosis.recovery.controlled_stop import PilotRecovery
from rampart.actors.runtime.actor import Context, Header
from rampart.manager.spec.tables import Positive


class ReducedSpeed(PilotRecovery):
    """The Safety Pilot lets nobody drive faster than a bound."""

    class Parameters(PilotRecovery.Parameters, frozen=True):
        """How slowly.

        Attributes:
            top_speed_mps: the bound.
        """

        top_speed_mps: Positive = 0.5

    parameters: Parameters
    mode = PilotMode.AUTO

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self.top_speed_mps = self.parameters.top_speed_mps

    def pilot_status(self, message: PilotStatus, header: Header) -> None:
        """See which bound the Safety Pilot keeps."""
        in_force = 0.0 < message.top_speed_mps <= self.top_speed_mps
        self.confirm(in_force=in_force, stamp_s=header.stamp,
                     reason=f"at most {message.top_speed_mps:g} m/s" if in_force
                     else "the safety pilot does not bound the speed")
