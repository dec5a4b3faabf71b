"""Hot standby of Osmosis Control: computes the same command in a process of its own.

It hears what the active one hears, and the follower finds its place on the route by the pose; so
the two agree without much of a word between them, and whoever is respawned agrees again within the
time of an acceleration ramp. The word that is needed is the active one's intent: whether it goes
back for a light, drives round something, how far aside it is still, and what its yaw loop has
learnt. These depend on what has happened and not on what can be seen. Nobody reads the standby's
command but the Safety Pilot, who lets it pass when the active one's is not usable
(`command_pair`), and the comparison (`rampart.actors.osmosis.detection.command_disagreement`).

What is done once stays with the active one: progress reports and light measurements. While the
standby drives, the mission's state waits; a light that is passed in that moment may be missed.
"""

from __future__ import annotations

from typing import Any, ClassVar

from rampart.actors.bus.topic import Topic
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.control.following.osmosis_control import OsmosisControl
from rampart.actors.osmosis.messages import ControlStatus
from rampart.actors.runtime.actor import Header, on


class StandbyControl(OsmosisControl):
    """Osmosis Control that publishes `control/standby_command` and nothing else."""

    command_topic = topics.STANDBY_COMMAND
    outputs: ClassVar[tuple[Topic[Any], ...]] = (topics.STANDBY_COMMAND,)

    @on(topics.CONTROL_STATUS)
    def active(self, message: ControlStatus, header: Header) -> None:
        """Do as the active one does."""
        self.core.adopt(message, header.stamp)

    def inform(self, now_s: float) -> None:
        """Say nothing: the lights and the status are the active one's."""

    def repeat(self) -> None:
        """Say nothing."""
