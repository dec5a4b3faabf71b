"""What the gateway says of ROS 2 by itself."""

from __future__ import annotations

from rampart.actors.bus.bounds import Count, Names, Texts
from rampart.actors.bus.messages import Message
from rampart.actors.bus.topic import Qos, Topic


class RosGraphReport(Message, frozen=True, omit_defaults=True):
    """Who is there in ROS 2: full names of nodes, those of which there are several, and problems.

    `bypassed` counts publishers of others on topics that the gateway publishes: what they say
    reaches the robot past every check. `refused` counts messages that were not passed on.
    """

    linked: bool
    nodes: Names
    several: Names
    bypassed: Count
    problems: Texts
    refused: Count = 0


GRAPH = Topic("ros2/{name}/graph", RosGraphReport, Qos.STATE, 1, "",
              "What gateway {name} sees of ROS 2; at once when it changes.")
