"""Osmosis Control that bridges a stale pose by dead reckoning, for a bounded distance.

The paper's (`osmosis_control`) goes on computing from the last pose it has, however old. This one
follows its route by odometry while localization is respawned, and stops when it does not know any
more where it is. A class of its own, because whoever hears odometry makes the base publish it.
"""

from __future__ import annotations

from rampart.actors.osmosis import topics
from rampart.actors.osmosis.control.following.dead_reckoning import DeadReckoning
from rampart.actors.osmosis.control.following.osmosis_control import OsmosisControl
from rampart.actors.osmosis.control.following.standby_control import StandbyControl
from rampart.actors.osmosis.messages import Odometry, Pose
from rampart.actors.runtime.actor import Context, Header, on
from rampart.manager.spec.schema import NonNegative


class BridgedControl(OsmosisControl):
    """Osmosis Control with `DeadReckoning` between localization and itself."""

    class Parameters(OsmosisControl.Parameters, frozen=True):
        """As of Osmosis Control, and how it bridges.

        Attributes:
            bridge_m: how far it drives without a fresh pose, m.
        """

        bridge_m: NonNegative = 3.0

    parameters: Parameters

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._reckoning = DeadReckoning(self.parameters.bridge_m)

    @on(topics.ODOMETRY)
    def odometry(self, message: Odometry, header: Header) -> None:
        """Keep the way that the wheels make."""
        pose = message.pose
        self._reckoning.odometry(
            header.stamp, (pose.x_m, pose.y_m, pose.yaw_rad), self.clock.now())

    @on(topics.POSE)
    def pose(self, message: Pose, header: Header) -> None:
        """Keep the latest pose."""
        self._reckoning.pose(
            header.stamp, (message.x_m, message.y_m, message.yaw_rad), self.clock.now())
        super().pose(message, header)

    def _where(self) -> Pose | None:
        here = self._reckoning.estimate(self.clock.now())
        return Pose(*here) if here is not None else None


class BridgedStandby(BridgedControl, StandbyControl):
    """The hot standby of `BridgedControl`."""
