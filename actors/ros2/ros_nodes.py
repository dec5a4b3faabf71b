"""`RosNodes`: detects missing nodes of ROS 2, and publishers that bypass the gateway.

When a node of ROS 2 ends, its liveliness token goes, which the gateway sees within some
milliseconds. A node that hangs keeps its token and falls silent: `Freshness` on one of its topics
detects that.
"""

from __future__ import annotations

import math
from typing import Annotated, Any

import msgspec

from rampart.actors.bus.bounds import Count, Names, Texts
from rampart.actors.bus.messages import Message
from rampart.actors.bus.topic import Members, Qos, Topic
from rampart.actors.detection.finding import Sustained
from rampart.actors.detection.module import DetectionModule
from rampart.actors.ros2.translation.tables import RosName
from rampart.actors.runtime.actor import Context, Header, on
from rampart.actors.runtime.parameters import NodeName, Suspects
from rampart.manager.spec.tables import NonNegative


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


_GRACE_S = 5.0


class RosNodes(DetectionModule):
    """Active while a node of ROS 2 is missing, or the gateway is bypassed, for long enough.

    No node is missing before the gateway has been linked once. A node that was never there is
    missing only after the system has had time to start, or a new router to collect its nodes. While
    the gateway has lost its router, the module is active and accuses no node.
    """

    class Parameters(DetectionModule.Parameters, frozen=True, kw_only=True):
        """Required nodes, and suspects.

        Attributes:
            gateway: node that sees the graph.
            nodes: full names of the required nodes of ROS 2, e.g. "/controller_server".
            alone: whether only the gateway may publish on the topics that it publishes.
            for_s: how long an error has to last, s.
            clear_s: how long there has to be no error before the module is idle again, s.
            suspects: nodes to restart when the module is active: the commands that run the missing
                nodes. If there are as many as `nodes`, each one runs the node in its place.
        """

        gateway: NodeName
        nodes: Annotated[tuple[RosName, ...], msgspec.Meta(max_length=100)] = ()
        alone: bool = False
        for_s: NonNegative = 0.0
        clear_s: NonNegative = 0.2
        suspects: Suspects = ()

        def __post_init__(self) -> None:
            """Refuse a module that watches nothing."""
            if not (self.nodes or self.alone):
                raise ValueError("nodes: missing; expected nodes, or alone = true")

    parameters: Parameters

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        given = self.parameters
        self.monitor = self.judged_by(Sustained(
            given.for_s, given.clear_s, self.known_after_s(given.for_s + given.clear_s)))
        self._seen: set[str] = set()
        self._suspects = dict(zip(given.nodes, given.suspects, strict=False))
        self._all_due_s = math.inf
        self._was_linked = False

    @classmethod
    def names(cls, topic: Topic[Any], name: str, parameters: Any) -> Members:
        """Subscribe to the report of its gateway only."""
        return (parameters.gateway,) if topic is GRAPH else super().names(topic, name, parameters)

    @on(GRAPH)
    def graph(self, report: RosGraphReport, header: Header) -> None:
        """Look for missing nodes and other publishers."""
        given, now_s = self.parameters, self.clock.now()
        self._was_linked = self._was_linked or report.linked
        if report.linked:
            self._all_due_s = min(self._all_due_s, now_s + self.grace_s(_GRACE_S))
            self._seen.update(report.nodes)
        else:  # a new router first has the nodes that find it first
            self._all_due_s = math.inf
            self._seen.clear()
        missing = [node for node in given.nodes if node not in report.nodes
                   and (node in self._seen or now_s >= self._all_due_s)]
        why = f"{', '.join(missing)}: not in the graph of ROS 2" if missing else ""
        if self._was_linked and not report.linked:
            why = f"{given.gateway} has no router of ROS 2: the nodes are unknown"
        if given.alone and report.bypassed:
            why = "; ".join(filter(None, (why, next(
                (one for one in report.problems if "publishes besides" in one), "bypassed"))))
        accused = self.accused(given.suspects, header)
        if len(given.nodes) == len(given.suspects):
            # Accused is the process that ran the node while it was there, not its successor.
            self._suspects |= {node: suspect for node, suspect in zip(
                given.nodes, accused, strict=True) if node in report.nodes}
            accused = tuple(self._suspects[node] for node in missing)
        self.monitor.accused = accused if missing else ()
        self.monitor.note(why, now_s)
        self.follow()
