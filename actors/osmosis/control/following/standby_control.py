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

import math
from typing import Any, ClassVar

from rampart.actors.bus.topic import Topic
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.control.following.light_row import LightRow
from rampart.actors.osmosis.control.following.osmosis_control import OsmosisControl
from rampart.actors.osmosis.control.following.path_follower import Motion, PathFollower
from rampart.actors.osmosis.messages import ControlPhase, ControlStatus, LightSample, MissionStatus
from rampart.actors.runtime.actor import Header, on

_ACTIVE_SILENT_S = 0.6
"""After so long without a status, three periods, the standby is the one in the loop."""


class StandbyControl(OsmosisControl):
    """Osmosis Control that publishes `control/standby_command` and nothing else."""

    command_topic = topics.STANDBY_COMMAND
    outputs: ClassVar[tuple[Topic[Any], ...]] = (topics.STANDBY_COMMAND,)

    @on(topics.CONTROL_STATUS)
    def active(self, message: ControlStatus, header: Header) -> None:
        """Do as the active one does."""
        if self._loop is not None and math.isfinite(message.turn_added_radps):
            self._loop.adopt(message.turn_added_radps, header.stamp + _ACTIVE_SILENT_S)
        route, follower = self._route, self._follower
        if route is None or (route.mission_id, route.step) != (message.mission_id, message.step):
            return
        if isinstance(follower, LightRow):
            follower.adopt(message.back_to[0] if message.back_to else None,
                           passing=message.passing)
        elif isinstance(follower, PathFollower) and message.phase is ControlPhase.FOLLOWING:
            follower.adopt_aside(message.aside_m)

    def repeat(self) -> None:
        """Say nothing: the status is the active one's."""

    def light(self, message: LightSample, header: Header) -> None:
        """Leave the lights to the active one."""

    def mission(self, message: MissionStatus, header: Header) -> None:
        """Leave the lights to the active one."""

    def _inspect(self, motion: Motion | None) -> None:
        pass

    def _report(self, motion: Motion | None) -> None:
        pass
