"""DM11: the mission does not advance, or somebody in the control chain has got stuck.

A node may be alive and beat, and its timer repeat a message that is no longer true. Watchdogs do
not see that. This module hears what the three control nodes hand on and names the one that
contradicts the others, so that it can be respawned.
"""

from __future__ import annotations

from rampart.actors.bus import messages as bm
from rampart.actors.detection.module import DetectionModule
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.detection.consistency_monitor import (
    ConsistencyLimits,
    ConsistencyMonitor,
)
from rampart.actors.runtime.actor import Context, Header, on


class MissionConsistency(DetectionModule):
    """Active while a control node contradicts the others, or its words are not updated."""

    class Parameters(DetectionModule.Parameters, ConsistencyLimits, frozen=True):
        """As of `ConsistencyLimits`."""

    parameters: Parameters

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self.monitor = self.judged_by(ConsistencyMonitor(
            self.parameters, self.clock.now(), known=self.first_life))

    @on(topics.MISSION_STATUS)
    @on(topics.GOAL)
    @on(topics.ROUTE)
    @on(topics.CONTROL_STATUS)
    def hear(self, message: bm.Message, header: Header) -> None:
        """Hear how the mission stands, its goal, the route, or how far the robot is."""
        self.monitor.heard(message, header.source, header.incarnation, header.stamp,
                           self.clock.now())
        self.follow()

    @on(topics.POSE)
    def pose(self, message: m.Pose, _header: Header) -> None:
        """Hear where the robot is."""
        self.monitor.pose(message.x_m, message.y_m, self.clock.now())
        self.follow()
