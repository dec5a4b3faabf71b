"""Hot standby of Osmosis Control: computes the same command in another process.

It has the inputs of the active instance, and its progress is the projection of the pose. So both
agree, and a restarted one agrees again after an acceleration ramp. It also takes the active one's
intent from its status, which depends on the past: going back for a light, passing an obstacle, the
lateral offset, and the correction of the yaw loop. Only the Safety Pilot (`command_pair`) and DM9
(`rampart.actors.osmosis.detection.command_disagreement`) read its command.

Progress reports and light measurements remain with the active instance. While the standby drives,
the mission's state waits; a light that is passed meanwhile may be missed.
"""

from __future__ import annotations

from typing import Any, ClassVar

from rampart.actors.bus.topic import Topic
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.control.following.osmosis_control import OsmosisControl
from rampart.actors.osmosis.messages import ControlStatus
from rampart.actors.runtime.actor import Header, on


class StandbyControl(OsmosisControl):
    """Osmosis Control that publishes only `control/standby_command`."""

    command_topic = topics.STANDBY_COMMAND
    outputs: ClassVar[tuple[Topic[Any], ...]] = (topics.STANDBY_COMMAND,)

    @on(topics.CONTROL_STATUS)
    def active(self, message: ControlStatus, header: Header) -> None:
        """Take over the intent of the active instance."""
        self.core.adopt(message, header.stamp)

    def inform(self, now_s: float) -> None:
        """Publish nothing: lights and status are published by the active instance."""

    def repeat(self) -> None:
        """Publish nothing."""
