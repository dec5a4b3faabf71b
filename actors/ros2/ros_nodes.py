"""`RosNodes`: nodes of ROS 2 that have to be there are not, or somebody publishes past the gateway.

A node of ROS 2 that ends takes its liveliness token with it, which the gateway sees within some
milliseconds; one that hangs keeps it, and falls silent: that is the subject of `Freshness` on a
topic of it.
"""

from __future__ import annotations

import math
from typing import Annotated, Any

import msgspec

from rampart.actors.bus.topic import Members, Topic
from rampart.actors.detection.finding import Sustained
from rampart.actors.detection.module import DetectionModule
from rampart.actors.ros2.messages import GRAPH, RosGraphReport
from rampart.actors.ros2.translation.tables import RosName
from rampart.actors.runtime.actor import Context, Header, on
from rampart.actors.runtime.parameters import NodeName, Suspects
from rampart.manager.spec.tables import NonNegative

_GRACE_S = 5.0


class RosNodes(DetectionModule):
    """Active while a node of ROS 2 is missing, or the gateway is bypassed, for long enough.

    Nothing is missed before the gateway was linked once, and a node that was never there not
    before the system has had time to start.
    """

    class Parameters(DetectionModule.Parameters, frozen=True, kw_only=True):
        """Which nodes, and whom to suspect.

        Attributes:
            gateway: node that sees the graph.
            nodes: full names of nodes of ROS 2 that have to be there, e.g. "/controller_server".
            alone: whether nobody but the gateway may publish on the topics that it publishes.
            for_s: how long it has to be so, s.
            clear_s: how long all has to be well before the module is idle again, s.
            suspects: names of nodes to be respawned when it is active: the commands that run what
                is missing. With as many as there are `nodes`, each stands for one.
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
                raise ValueError("nodes: missing; say nodes, or alone = true")

    parameters: Parameters

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        said = self.parameters
        self.monitor = self.judged_by(Sustained(
            said.for_s, said.clear_s, self.known_after_s(said.for_s + said.clear_s)))
        self._seen: set[str] = set()
        self._all_due_s = math.inf

    @classmethod
    def names(cls, topic: Topic[Any], name: str, parameters: Any) -> Members:
        """Hear its gateway."""
        return (parameters.gateway,) if topic is GRAPH else super().names(topic, name, parameters)

    @on(GRAPH)
    def graph(self, report: RosGraphReport, _header: Header) -> None:
        """See who is missing."""
        said, now_s = self.parameters, self.clock.now()
        if report.linked and self._all_due_s == math.inf:
            self._all_due_s = now_s + self.grace_s(_GRACE_S)
        self._seen.update(report.nodes)
        missing = [node for node in said.nodes if node not in report.nodes
                   and (node in self._seen or now_s >= self._all_due_s)]
        why = f"{', '.join(missing)}: not in the graph of ROS 2" if missing else ""
        if said.alone and report.bypassed:
            why = "; ".join(filter(None, (why, next(
                (one for one in report.problems if "publishes besides" in one), "bypassed"))))
        self.monitor.accused = tuple(
            suspect for node, suspect in zip(said.nodes, said.suspects, strict=True)
            if node in missing) if len(said.nodes) == len(said.suspects) else (
                said.suspects if missing else ())
        self.monitor.note(why, now_s)
        self.follow()
