"""The gateway to ROS 2: an actor with a session of its own among those of `rmw_zenoh`.

It passes on what the tables `[[ros2]]` of the system say, and nothing else; each is an endpoint of
a node in the graph of ROS 2, where `ros2 node info` shows it. It hears the graph, tells the system
who is there, and tells ROS 2 on `/diagnostics` and `/rampart/decision` what is detected and what is
decided.

What is wrong is told in one line on `diagnostic/GATEWAY` and not passed on: what is no message of
its type, in another frame, of another publisher, or of a time that cannot be. So nothing that is
wrong moves the robot, and what watches the topic sees it fall silent.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping
from functools import cache, partial
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

from rampart.actors.bus.bounds import MANY, NAME_CHARS, clip
from rampart.actors.bus.recorder_connection import RecorderConnection
from rampart.actors.bus.topic import Topic
from rampart.actors.ftm import topics
from rampart.actors.ftm.messages import DecisionRecord, DetectionReport, RecoveryReport
from rampart.actors.ros2.calls import (
    Called,
    Goal,
    Served,
    answer_topic,
    request_topic,
)
from rampart.actors.ros2.diagnostics import Diagnostics
from rampart.actors.ros2.graph import RosGraph, misfits
from rampart.actors.ros2.links import HeardTopic, SaidTopic
from rampart.actors.ros2.messages import GRAPH, RosGraphReport
from rampart.actors.ros2.node import RosNode
from rampart.actors.ros2.ros_clock import NS, RosClock
from rampart.actors.ros2.side import Mode, NoSide, Side
from rampart.actors.ros2.stand_in import side_of, wall_ns
from rampart.actors.ros2.translation.mirror import topic_of
from rampart.actors.ros2.translation.tables import ROUTER, Ros2Link, read_links
from rampart.actors.ros2.translation.types import Distribution, Types
from rampart.actors.ros2.wire import ADMIN, EndpointKind, Qos
from rampart.actors.runtime.actor import Actor, Context, Header, every, on
from rampart.actors.runtime.parameters import Named, named
from rampart.manager.spec.schema import SystemSpec

_CLOCK, _CLOCK_TYPE = "/clock", "rosgraph_msgs/msg/Clock"
_SETTLE_S = 0.05
_PROBLEMS = 50



@cache
def types_of(distribution: str, folders: tuple[str, ...]) -> Types:
    """Return the types of a distribution and of folders, which are read once.

    Raises:
        ValueError: see `Types`.
    """
    return Types(distribution, map(Path, folders))


class Gateway(Actor):
    """Passes topics, services and actions on between ROS 2 and the system."""

    class Parameters(Actor.Parameters, frozen=True, kw_only=True):
        """Where ROS 2 is, and what it is called there.

        Attributes:
            connect: endpoints of its routers.
            mode: "client", which works from any machine, or "peer", which on the machine of ROS 2
                goes on when its router ends.
            domain: ROS_DOMAIN_ID.
            distribution: by name.
            node: name of the gateway's node.
            namespace: of that node.
            interfaces: folders with definitions of the robot's own, relative to the system's file.
            clock: "wall", or "ros" where nodes have use_sim_time.
            diagnostics: whether ROS 2 is told what is detected and decided.
            ros2: the tables of the system, given.
        """

        connect: tuple[str, ...] = (ROUTER,)
        mode: Mode = "client"
        domain: Annotated[int, msgspec.Meta(ge=0, le=232)] = 0
        distribution: Distribution = "jazzy"
        node: Annotated[str, msgspec.Meta(pattern=r"^[A-Za-z_][A-Za-z0-9_]{0,60}\Z")] = "rampart"
        namespace: Annotated[
            str, msgspec.Meta(pattern=r"^(/|(/[A-Za-z_][A-Za-z0-9_]*)+)\Z", max_length=200)] = "/"
        interfaces: tuple[str, ...] = ()
        clock: Literal["wall", "ros"] = "wall"
        diagnostics: bool = True
        ros2: tuple[Ros2Link, ...] = ()

    parameters: Parameters
    tables = ("ros2",)
    outputs = (GRAPH,)

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        said = self.parameters
        self.graph = RosGraph()
        self.time = RosClock(said.clock, self.clock.now, self.clock.rate, partial(wall_ns, self))
        self._types = _types(said)
        self._side: Side | None = None
        self._links: dict[tuple[str, str], SaidTopic | Called | Goal] = {}
        self._graph_due = False
        self._was_linked = False
        self._diagnostics: Diagnostics | None = None
        self._newest: dict[str, tuple[msgspec.Struct, float] | None] = {
            link.beside: None for link in said.ros2 if link.beside}
        for link in said.ros2:
            if link.from_:
                self.hear_topic(link.from_, self._passed_on(link))

    # -- what its class says before a run ---------------------------------------------------------

    @classmethod
    def given(cls, name: str, spec: SystemSpec, file: str) -> dict[str, Any]:
        """Return the links that it passes on; raises as that of its base."""
        own = next(node.actor for node in spec.nodes if node.name == name)
        gateways = [node.name for node in spec.nodes if node.actor == own]
        return {"ros2": tuple(link for link in read_links(spec, gateways, file)
                              if (link.gateway or gateways[0]) == name)}

    @classmethod
    def named(cls, parameters: Parameters) -> dict[str, list[Named]]:
        """Return what its links take and make, besides what its parameters name."""
        found = super().named(parameters)
        for link in parameters.ros2:
            for way, key, name in (("heard", link.from_, "from"), ("published", link.to, "to")):
                if key:
                    found[way].append(named(name, key, row=f"ros2 {link.name}: "))
        return found

    @classmethod
    def own_topics(cls, parameters: Parameters) -> tuple[Topic[Any], ...]:
        """Return the topics that are made of types of ROS 2.

        Raises:
            ValueError: one of them is not known; table and field are named.
        """
        types, found = _types(parameters), []
        for link in parameters.ros2:
            with _named(link):
                if link.way == "subscribe":
                    found.append(topic_of(link, types))
                elif link.way != "publish":
                    found.append(answer_topic(link, types))
                    if link.from_:
                        found.append(request_topic(link, types))
        return tuple(found)

    @classmethod
    def check_topics(cls, parameters: Parameters, topics: Mapping[str, Topic[Any]]) -> None:
        """Refuse links that cannot be.

        Raises:
            ValueError: a field or type does not exist; table and field are named.
        """
        types = _types(parameters)
        for link in parameters.ros2:
            with _named(link):
                cls._check(link, types, topics)

    @staticmethod
    def _check(link: Ros2Link, types: Types, topics: Mapping[str, Topic[Any]]) -> None:
        made: Any = {"subscribe": HeardTopic, "publish": SaidTopic, "call": Called,
                     "serve": Served, "goal": Goal}[link.way]
        made(_Nobody(types), link,
             *(topics[key] for key in (link.from_, link.to, link.beside) if key))

    # -- a run ------------------------------------------------------------------------------------

    def on_start(self) -> None:
        """Enter the graph of ROS 2, and declare everything there."""
        said, run = self.parameters, self.context.run
        self._recorder = RecorderConnection(run.plan.base_port)
        self._side = side_of(self, self._bus, said.connect, said.mode, self._recorder.take)
        self.node = RosNode(self._side, self._types, said.node, wall_ns=partial(wall_ns, self),
                            refuse=self.refuse, namespace=said.namespace, domain=said.domain)
        if said.clock == "ros":
            tell = self._types.decoder(_CLOCK_TYPE)
            self.node.subscribe(_CLOCK, _CLOCK_TYPE, Qos(reliable=False, depth=1),
                                lambda payload, _attachment: self._clock(tell, payload))
        for link in said.ros2:
            to, heard = (self.chosen_topic(key) if key else None for key in (link.to, link.from_))
            if link.way == "subscribe" and to is not None:
                HeardTopic(self, link, to,
                           self.chosen_topic(link.beside) if link.beside else None)
            elif link.way == "serve" and to is not None:
                Served(self, link, to)
            elif link.way == "publish" and heard is not None:
                self._links[link.way, link.name] = SaidTopic(self, link, heard)
            elif heard is not None and to is not None:
                self._links[link.way, link.name] = (Called if link.way == "call" else Goal)(
                    self, link, heard, to)
        if said.diagnostics:
            system = run.system
            titles = {d.name: d.title for d in system.detections} | {
                r.name: r.title for r in system.recoveries}
            self._diagnostics = Diagnostics(self.node, titles, system.name, self.time.ros_ns)
        self._side.tokens(f"{ADMIN}/{said.domain}/**", self._token)
        for name, note in self._types.notes.items():
            self._note(name, note)

    def on_stop(self) -> None:
        """Leave the graph."""
        if self._side is not None:
            self._side.close()
            self._recorder.close()

    def _passed_on(self, link: Ros2Link) -> Callable[[Any, Header], None]:
        def heard(message: Any, header: Header) -> None:
            self._links[link.way, link.name].heard(message, header)

        return heard

    # -- what links need --------------------------------------------------------------------------

    def now_s(self) -> float:
        """Return simulated time."""
        return self.clock.now()

    def newest(self, key: str) -> tuple[msgspec.Struct, float] | None:
        """Return what was said last on a topic of the system, and its stamp."""
        return self._newest.get(key)

    def say(self, topic: Topic[Any], body: msgspec.Struct, stamp_s: float | None) -> None:
        """Publish to the system."""
        if topic.key in self._newest:
            self._newest[topic.key] = body, self.clock.now() if stamp_s is None else stamp_s
        self.publish(topic, body, stamp_s)

    def refuse(self, where: str, why: str) -> None:
        """Tell that a message was not passed on, and count it."""
        self._rejected += 1
        self._note(where, why)

    def _note(self, where: str, why: str) -> None:
        self.report_diagnostic("ros2", why, clip(where, NAME_CHARS))

    def handle(self, slot: str | None, call: Callable[[], None]) -> None:
        """Have a call made in turn; of those with the same slot the latest counts."""
        self._dispatcher.put_message(slot, call)

    def later(self, delay_s: float, call: Callable[[], None]) -> None:
        """Have a call made after so many simulated seconds."""
        self.call_later(delay_s, call)

    def _clock(self, decode: Callable[[bytes], Any], payload: bytes) -> None:
        try:
            told = decode(payload).clock
        except ValueError as error:
            self.refuse(_CLOCK, str(error))
            return
        self.time.tell(told.sec * NS + told.nanosec)

    # -- the graph --------------------------------------------------------------------------------

    def _token(self, token: str, alive: bool) -> None:
        self.handle(None, lambda: self._graph_changed(token, alive))

    def _graph_changed(self, token: str, alive: bool) -> None:
        try:
            if self.graph.changed(token, alive) is None:
                return
        except ValueError as error:
            self._note("graph", str(error))
            return
        if not self._graph_due:  # what comes together is told together
            self._graph_due = True
            self.call_later(_SETTLE_S, self._tell_graph)

    @every(1.0)
    def look(self) -> None:
        """Say what the graph is, and how the modules are."""
        self._tell_graph()
        if self._diagnostics is not None and self.time.is_known:
            self._diagnostics.tell(self.clock.now())

    def _tell_graph(self) -> None:
        self._graph_due = False
        if self._side is None:
            return
        is_linked = self._side.is_linked()
        if self._was_linked and not is_linked:
            self._note("graph", f"no router at {', '.join(self.parameters.connect)} any more")
        self._was_linked = is_linked
        nodes = self.graph.nodes()
        bypassed = self._bypassed()
        problems = [f"{topic}: {who} publishes besides {self.node.full_name}"
                    for topic, who in bypassed] + self._misfits()
        self.publish(GRAPH, RosGraphReport(
            is_linked, tuple(clip(one, NAME_CHARS) for one in list(nodes)[:MANY]),
            tuple(clip(name, NAME_CHARS) for name, count in nodes.items() if count > 1)[:MANY],
            len(bypassed), tuple(map(clip, problems[:_PROBLEMS])), self._rejected))

    def _bypassed(self) -> list[tuple[str, str]]:
        """Return who else publishes on the topics on which the gateway does, by topic."""
        mine = {link.publish for link in self.parameters.ros2 if link.publish}
        return [(one.topic, one.full_name) for one in self.graph.of(EndpointKind.PUBLISHER)
                if one.topic in mine and not self._is_mine(one.session)]

    def _misfits(self) -> list[str]:
        everybody = self.graph.of(*EndpointKind)
        here = [one for one in everybody if self._is_mine(one.session)]
        there = [one for one in everybody if not self._is_mine(one.session)]
        return list(dict.fromkeys(misfits(here, there)))

    def _is_mine(self, session: str) -> bool:
        return self._side is not None and session == self._side.id

    # -- what ROS 2 is told -----------------------------------------------------------------------

    @on(topics.DETECTION)
    def detection(self, report: DetectionReport, header: Header) -> None:
        """Tell a detection at once."""
        self._reported(header.source, report)

    @on(topics.RECOVERY)
    def recovery(self, report: RecoveryReport, header: Header) -> None:
        """Tell a recovery at once."""
        self._reported(header.source, report)

    def _reported(self, name: str, report: DetectionReport | RecoveryReport) -> None:
        told, now_s = self._diagnostics, self.clock.now()
        if told is not None and told.heard(name, report, now_s) and self.time.is_known:
            told.tell(now_s)

    @on(topics.DECISION)
    def decision(self, record: DecisionRecord, _header: Header) -> None:
        """Tell a decision."""
        if self._diagnostics is not None:
            self._diagnostics.decided(record)


class _Nobody:
    """A gateway that is not there, to which links are made to see whether they can be."""

    def __init__(self, types: Types) -> None:
        self.node = RosNode(NoSide(), types, "nobody", wall_ns=lambda: 0, refuse=self.refuse)
        self.graph = RosGraph()
        self.time = RosClock("wall", self.now_s, 1.0, lambda: 0)

    def now_s(self) -> float:
        """Return that no time passes."""
        return 0.0

    def refuse(self, where: str, why: str) -> None:
        """Nobody is told."""

    def newest(self, key: str) -> tuple[msgspec.Struct, float] | None:
        """Return that nothing was said."""

    def say(self, topic: Topic[Any], body: msgspec.Struct, stamp_s: float | None) -> None:
        """Nobody hears."""

    def handle(self, slot: str | None, call: Callable[[], None]) -> None:
        """Nothing arrives."""

    def later(self, delay_s: float, call: Callable[[], None]) -> None:
        """No time passes."""


def _types(said: Gateway.Parameters) -> Types:
    try:
        return types_of(said.distribution, said.interfaces)
    except ValueError as error:
        raise ValueError(f"parameters.interfaces: {error}") from None


@contextlib.contextmanager
def _named(link: Ros2Link) -> Iterator[None]:
    """Name the table in what is wrong with a link."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"ros2 {link.name}: {error}") from None
