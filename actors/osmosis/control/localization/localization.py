"""Localization as in the paper: the simulator's absolute pose (section V).

The pose keeps the stamp of its measurement, so that a late pose is old for DM6.
"""

from __future__ import annotations

import math

from rampart.actors.ftm.plausible import is_possible
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.messages import Pose
from rampart.actors.osmosis.readings import is_pose
from rampart.actors.runtime.actor import Actor, Context, Header, on


def is_newer(pose: Pose, stamp_s: float, last_stamp_s: float, now_s: float) -> bool:
    """Whether a measurement is valid and newer than the last one."""
    return stamp_s > last_stamp_s and is_possible(stamp_s, now_s) and is_pose(pose)


class Localization(Actor):
    """Passes the absolute pose on; stateless."""

    outputs = (topics.POSE,)

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._last_stamp_s = -math.inf

    @on(topics.ABSOLUTE_POSE)
    def absolute_pose(self, pose: Pose, header: Header) -> None:
        """Pass a newer, valid measurement on with its stamp."""
        if is_newer(pose, header.stamp, self._last_stamp_s, self.clock.now()):
            self._last_stamp_s = header.stamp
            self.publish(topics.POSE, pose, stamp=header.stamp)
