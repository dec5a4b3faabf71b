"""The gateway's report on the graph of ROS 2."""

from __future__ import annotations

from rampart.actors.bus.bounds import Count, Names, Texts
from rampart.actors.bus.messages import Message
from rampart.actors.bus.topic import Qos, Topic


class RosGraphReport(Message, frozen=True, omit_defaults=True):
    """Nodes of ROS 2 by full name, names that several nodes have, and problems.

    `bypassed` counts other publishers on the gateway's topics: their messages reach the robot
    without any check. `refused` counts messages that were not passed on.
    """

    linked: bool
    nodes: Names
    several: Names
    bypassed: Count
    problems: Texts
    refused: Count = 0


GRAPH = Topic("ros2/{name}/graph", RosGraphReport, Qos.STATE, 1, "",
              "Nodes of ROS 2 that gateway {name} sees; at once when they change.")
