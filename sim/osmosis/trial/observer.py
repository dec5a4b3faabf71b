"""The observer of Osmosis: it hears mission, lights, pose and ground truth, too."""

from __future__ import annotations

from typing import Any

from rampart.actors.osmosis import topics
from rampart.actors.runtime.actor import Header, on
from rampart.sim.runs.observer import Observer


class OsmosisObserver(Observer):
    """Passes what the robot says to its sinks as well."""

    @on(topics.MISSION_STATUS)
    @on(topics.CONTROL_STATUS)
    @on(topics.LIGHT_MEASURED)
    @on(topics.POSE)
    @on(topics.PILOT_STATUS)
    @on(topics.TRUTH)
    @on(topics.OBSTACLES)
    def heard_of_robot(self, message: Any, header: Header) -> None:
        """Pass one message on."""
        self.heard(message, header)
