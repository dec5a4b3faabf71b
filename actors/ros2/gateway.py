"""The gateway to ROS 2: an actor that is also a node of ROS 2.

There it has a second Zenoh session, among those of `rmw_zenoh`, or a relay, over any middleware.
It passes on what the tables `[[ros2]]` of the system list, and nothing else. Each row is an
endpoint of a node in the graph of ROS 2, where `ros2 node info` shows it. The gateway watches the
graph and reports its nodes to the system. It reports detections to ROS 2 on `/diagnostics`, and
decisions on `/rampart/decision`.

It refuses a message that does not decode, is in another frame, comes from a second publisher, or
has an impossible stamp, and reports it in one line on `diagnostic/GATEWAY`. So a wrong message
does not move the robot, and a detection module sees the topic fall silent.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping
from functools import cache, partial
from pathlib import Path
from typing import Annotated, Any, Literal, cast

import msgspec

from rampart.actors.bus.bounds import MANY, NAME_CHARS, clip
from rampart.actors.bus.recorder_connection import RecorderConnection
from rampart.actors.bus.topic import Topic
from rampart.actors.foreign.output_log import OutputLog
from rampart.actors.foreign.program import log_folder, make_log_folder
from rampart.actors.ftm import topics
from rampart.actors.ftm.messages import DecisionRecord, DetectionReport, RecoveryReport
from rampart.actors.ros2.diagnostics import Diagnostics
from rampart.actors.ros2.links import (
    ActionCall,
    Publication,
    ServiceCall,
    Subscription,
    answer_topic,
    check_call,
    request_topic,
)
from rampart.actors.ros2.node import RosNode
from rampart.actors.ros2.relay_side import RelayError, RelaySide
from rampart.actors.ros2.ros_clock import NS, RosClock
from rampart.actors.ros2.ros_nodes import GRAPH, RosGraphReport
from rampart.actors.ros2.side import Mode, Side, Tls
from rampart.actors.ros2.stand_in import side_of, wall_ns
from rampart.actors.ros2.translation.mapping import Inward, Outward, topic_of
from rampart.actors.ros2.translation.tables import ROUTER, Ros2Link, read_links
from rampart.actors.ros2.translation.types import Distribution, Types
from rampart.actors.ros2.wire import ADMIN, EndpointKind, Qos, RosGraph, misfits
from rampart.actors.runtime.actor import Actor, Context, Header, every, on
from rampart.actors.runtime.parameters import Named, named
from rampart.manager.spec.schema import SystemSpec

_CLOCK, _CLOCK_TYPE = "/clock", "rosgraph_msgs/msg/Clock"
_SETTLE_S = 0.05
_PROBLEMS = 50
_LINK_S = 2.0
"""Without a router for so long after its start, the gateway reports it."""


@cache
def types_of(distribution: str, folders: tuple[str, ...]) -> Types:
    """Return the types of a distribution and of folders, which are read once; raises as `Types`."""
    return Types(distribution, map(Path, folders))


class Gateway(Actor):
    """Passes topics, services and actions on between ROS 2 and the system."""

    class Parameters(Actor.Parameters, frozen=True, kw_only=True):
        """Address of ROS 2, and the gateway's name there.

        Attributes:
            middleware: "zenoh" for `rmw_zenoh`, without an installation of ROS 2, or "rclpy" for
                the middleware of an installation, such as DDS.
            setup: with "rclpy", the file that bash sources first, relative to the system's file;
                "" for the environment or, if that has no ROS 2, /opt/ros/DISTRIBUTION/setup.bash.
            connect: endpoints of the routers of ROS 2.
            mode: "client", which works from any machine, or "peer", which works on the machine of
                ROS 2 only and survives its router.
            tls: PEM files for endpoints "tls/…", relative to the system's file.
            domain: ROS_DOMAIN_ID.
            distribution: name of the distribution.
            node: name of the gateway's node.
            namespace: namespace of that node.
            interfaces: folders with the robot's definitions, relative to the system's file.
            clock: "wall", or "ros" where nodes have use_sim_time.
            diagnostics: whether detections and decisions are reported to ROS 2.
            ros2: rows `[[ros2]]` of the system, filled in by `given`.
        """

        middleware: Literal["zenoh", "rclpy"] = "zenoh"
        setup: str = ""
        connect: tuple[str, ...] = (ROUTER,)
        mode: Mode = "client"
        tls: Tls | None = None
        domain: Annotated[int, msgspec.Meta(ge=0, le=232)] = 0
        distribution: Distribution = "jazzy"
        node: Annotated[str, msgspec.Meta(pattern=r"^[A-Za-z_][A-Za-z0-9_]{0,60}\Z")] = "rampart"
        namespace: Annotated[
            str, msgspec.Meta(pattern=r"^(/|(/[A-Za-z_][A-Za-z0-9_]*)+)\Z", max_length=200)] = "/"
        interfaces: tuple[str, ...] = ()
        clock: Literal["wall", "ros"] = "wall"
        diagnostics: bool = True
        ros2: tuple[Ros2Link, ...] = ()

        def __post_init__(self) -> None:
            """Refuse a setup that nothing would source, TLS without files, and the reverse."""
            if self.setup and self.middleware != "rclpy":
                raise ValueError('setup: is for middleware = "rclpy"')
            for endpoint in self.connect:
                if endpoint.startswith("tls/") != (self.tls is not None):
                    raise ValueError(f"connect {endpoint!r}: expected " + (
                        "'tls/…' with tls" if self.tls else "tls = { ca = 'FILE' } with 'tls/…'"))

    parameters: Parameters
    tables = ("ros2",)
    outputs = (GRAPH,)

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        given = self.parameters
        self.graph = RosGraph()
        self.time = RosClock(given.clock, self.clock.now, self.clock.rate, partial(wall_ns, self))
        self._types = _types(given)
        self._side: Side | None = None
        self._relay: RelaySide | None = None  # the same, if it is one
        self._links: dict[tuple[str, str], Publication | ServiceCall | ActionCall] = {}
        self._subscriptions: dict[str, Subscription] = {}
        self._graph_due = False
        self._was_linked: bool | None = None
        self._due_s = self.clock.now() + _LINK_S
        self._others_had_time = False
        self._diagnostics: Diagnostics | None = None
        self._newest: dict[str, tuple[msgspec.Struct, float] | None] = {
            link.beside: None for link in given.ros2 if link.beside}
        for link in given.ros2:
            if link.from_:
                self.hear_topic(link.from_, self._taker(link))

    # -- before a run ----------------------------------------------------------------------------

    @classmethod
    def given(cls, name: str, spec: SystemSpec, file: str) -> dict[str, Any]:
        """Return the rows of this gateway; raises as the base class."""
        own = next(node.actor for node in spec.nodes if node.name == name)
        gateways = [node.name for node in spec.nodes if node.actor == own]
        return {"ros2": tuple(link for link in read_links(spec, gateways, file)
                              if (link.gateway or gateways[0]) == name)}

    @classmethod
    def named(cls, parameters: Parameters) -> dict[str, list[Named]]:
        """Return the topics of its links and of its parameters."""
        found = super().named(parameters)
        for link in parameters.ros2:
            for way, key, name in (("heard", link.from_, "from"), ("published", link.to, "to")):
                if key:
                    found[way].append(named(name, key, row=f"ros2 {link.name}: "))
        return found

    @classmethod
    def on_wall_clock(cls, parameters: Parameters) -> bool:
        """See `Declared.on_wall_clock`."""
        return parameters.clock == "wall"

    @classmethod
    def own_topics(cls, parameters: Parameters) -> tuple[Topic[Any], ...]:
        """Return the topics whose types are made from types of ROS 2.

        Raises:
            ValueError: a type is not known; the text names row and field.
        """
        types, found = _types(parameters), []
        for link in parameters.ros2:
            with _named(link):
                if link.way == "subscribe":
                    found.append(topic_of(link, types))
                elif link.way != "publish":
                    found += [answer_topic(link, types), request_topic(link, types)]
        return tuple(found)

    @classmethod
    def check_topics(cls, parameters: Parameters, topics: Mapping[str, Topic[Any]]) -> None:
        """Refuse links that cannot be translated.

        Raises:
            ValueError: a field or type does not exist; the text names row and field.
        """
        types = _types(parameters)
        for link in parameters.ros2:
            asks, answers, beside = (  # the first two are there as the kind of the link needs them
                cast("Any", topics[key].type if key else None)
                for key in (link.from_, link.to, link.beside))
            with _named(link):
                if link.way == "subscribe":
                    types.decoder(link.type)
                    Inward(link, types, answers, beside)
                elif link.way == "publish":
                    Outward(link, types, asks)
                else:
                    check_call(link, types, asks, answers)

    # -- a run ------------------------------------------------------------------------------------

    def on_start(self) -> None:
        """Join the graph of ROS 2, and declare all endpoints."""
        given, run = self.parameters, self.context.run
        self._recorder = RecorderConnection(run.plan.base_port)
        if given.middleware == "rclpy" and not run.plan.virtual:
            self._side = self._relay = self._start_relay()
        else:
            self._side = side_of(self, self._bus, given.connect, given.mode, tls=given.tls)
        self.node = RosNode(self._side, self._types, given.node, wall_ns=partial(wall_ns, self),
                            refuse=self.refuse, namespace=given.namespace, domain=given.domain,
                            record=None if run.plan.virtual else self._recorder.take)
        if given.clock == "ros":
            decode = self._types.decoder(_CLOCK_TYPE)
            self.node.subscribe(_CLOCK, _CLOCK_TYPE, Qos(reliable=False, depth=1),
                                lambda payload, _attachment: self._clock(decode, payload))
        for link in given.ros2:
            to, from_ = (self.chosen_topic(key) if key else None for key in (link.to, link.from_))
            if link.way == "subscribe" and to is not None:
                self._subscriptions[link.name] = Subscription(
                    self, link, to, self.chosen_topic(link.beside) if link.beside else None)
            elif link.way == "publish" and from_ is not None:
                self._links[link.way, link.name] = Publication(self, link, from_)
            elif from_ is not None and to is not None:
                self._links[link.way, link.name] = (
                    ServiceCall if link.way == "call" else ActionCall)(self, link, from_, to)
        if given.diagnostics:
            system = run.system
            titles = {d.name: d.title for d in system.detections} | {
                r.name: r.title for r in system.recoveries}
            self._diagnostics = Diagnostics(self.node, titles, system.name, self.time.ros_ns)
        self._side.tokens(f"{ADMIN}/{given.domain}/**", self._token)
        for name, note in self._types.notes.items():
            self._note(name, note)
        self.call_later(run.system.timing.startup_grace_s, self._report_unpublished)

    def _start_relay(self) -> RelaySide:
        given, run = self.parameters, self.context.run
        if why := make_log_folder(run.plan):
            self._note("relay", why)
        log = OutputLog(log_folder(run.plan) / f"{self.name}.log")
        log.note(f"{self.name} #{self.context.incarnation} starts its relay")
        return RelaySide(given.node, given.namespace, given.domain, given.distribution,
                         given.setup, lost=self._relay_lost, output=log.write,
                         first_s=run.system.timing.startup_grace_s)

    def _relay_lost(self, error: RelayError) -> None:
        def fail() -> None:
            raise error

        self.enqueue(None, fail)

    def is_well(self) -> bool:
        """Whether the relay answers, if there is one."""
        return self._relay is None or self._relay.is_well(self.clock.now())

    def on_stop(self) -> None:
        """Stop what the gateway commands, and leave the graph."""
        if self._side is not None:
            for link in self._links.values():
                if isinstance(link, Publication):
                    link.end()
            self._side.close()
            self._recorder.close()

    def _taker(self, link: Ros2Link) -> Callable[[Any, Header], None]:
        def take(message: Any, header: Header) -> None:
            self._links[link.way, link.name].take(message, header)

        return take

    # -- for the links ---------------------------------------------------------------------------

    def newest(self, key: str) -> tuple[msgspec.Struct, float] | None:
        """Return the newest message on a topic that a link names as `beside`, and its stamp."""
        return self._newest.get(key)

    def emit(self, topic: Topic[Any], body: msgspec.Struct, stamp_s: float | None) -> None:
        """Publish a message to the system; None stamps it now."""
        if topic.key in self._newest:
            self._newest[topic.key] = body, self.clock.now() if stamp_s is None else stamp_s
        self.publish(topic, body, stamp_s)

    def refuse(self, where: str, why: str) -> None:
        """Report and count a message that is not passed on."""
        self._rejected += 1
        self._note(where, why)

    def _note(self, where: str, why: str) -> None:
        self.report_diagnostic("ros2", why, clip(where, NAME_CHARS))

    def enqueue(self, slot: str | None, call: Callable[[], None]) -> None:
        """Put a call into the mailbox; it replaces one in the same slot that still waits."""
        self._dispatcher.put_message(slot, call)

    def _clock(self, decode: Callable[[bytes], Any], payload: bytes) -> None:
        try:
            clock = decode(payload).clock
        except ValueError as error:
            self.refuse(_CLOCK, str(error))
            return
        self.time.set(clock.sec * NS + clock.nanosec)

    # -- the graph --------------------------------------------------------------------------------

    def _token(self, token: str, alive: bool) -> None:
        self.enqueue(None, lambda: self._graph_changed(token, alive))

    def _graph_changed(self, token: str, alive: bool) -> None:
        try:
            if self.graph.changed(token, alive) is None:
                return
        except ValueError as error:
            self._note("graph", str(error))
            return
        if not self._graph_due:  # one report for changes that come together
            self._graph_due = True
            self.call_later(_SETTLE_S, self._report_graph)

    @every(1.0)
    def look(self) -> None:
        """Report the graph to the system, and the modules to ROS 2."""
        self._report_graph()
        if self._diagnostics is not None and self.time.is_known:
            self._diagnostics.publish(self.clock.now())

    def _report_unpublished(self) -> None:
        """Report the topics that no node publishes, once the others have had time to start."""
        self._others_had_time = True
        for topic, why in self._unpublished():
            self._note(topic, why)

    def _report_graph(self) -> None:
        self._graph_due = False
        if self._side is None:
            return
        is_linked = self._side.is_linked()
        if self._relay is None:  # a relay that is lost ends this process
            self._follow_link(is_linked)
        nodes = self.graph.nodes()
        bypassed = self._bypassed()
        problems = [f"{topic}: {who} publishes besides {self.node.full_name}"
                    for topic, who in bypassed] + self._strangers() + self._misfits() + [
                        *(self._relay.problems if self._relay else ()),
                        *(f"{topic}: {why}" for topic, why in self._unpublished())]
        self.publish(GRAPH, RosGraphReport(
            is_linked, tuple(clip(one, NAME_CHARS) for one in list(nodes)[:MANY]),
            tuple(clip(name, NAME_CHARS) for name, count in nodes.items() if count > 1)[:MANY],
            len(bypassed), tuple(map(clip, problems[:_PROBLEMS])), self._rejected))

    def _follow_link(self, is_linked: bool) -> None:
        """Report that the router is lost, missing at the start, or back: once each."""
        where, has_missed = ", ".join(self.parameters.connect), self._was_linked is False
        if is_linked and has_missed:
            self._note("router", f"linked to {where} again")
        elif not is_linked and not has_missed:
            if self._was_linked is None and self.clock.now() < self._due_s:
                return
            self._note("no router", f"no router at {where}; the gateway goes on dialling")
        self._was_linked = is_linked

    def _bypassed(self) -> list[tuple[str, str]]:
        """Return topics of the gateway with another publisher, each with that publisher."""
        mine = {link.publish for link in self.parameters.ros2 if link.publish}
        return [(one.topic, one.full_name) for one in self.graph.of(EndpointKind.PUBLISHER)
                if one.topic in mine and not self._is_mine(one.session)]

    def _strangers(self) -> list[str]:
        expected = {link.subscribe: link.publisher for link in self.parameters.ros2
                    if link.publisher}
        return [f"{one.topic}: {one.full_name} publishes; only messages of {expected[one.topic]} "
                "are passed on" for one in self.graph.of(EndpointKind.PUBLISHER)
                if expected.get(one.topic, one.full_name) != one.full_name]

    def _unpublished(self) -> list[tuple[str, str]]:
        """Return subscribed topics without publisher and messages, each with the report."""
        if not self._others_had_time or self._side is None or not self._side.is_linked():
            return []
        there = {one.topic for one in self.graph.of(EndpointKind.PUBLISHER)}
        why = (f"no node publishes it in domain {self.parameters.domain}; `rampart ros2 check` "
               "looks for the cause")
        return [(topic, why) for topic, subscription in self._subscriptions.items()
                if topic not in there and not subscription.has_received]

    def _misfits(self) -> list[str]:
        endpoints = self.graph.of(*EndpointKind)
        here = [one for one in endpoints if self._is_mine(one.session)]
        there = [one for one in endpoints if not self._is_mine(one.session)]
        return list(dict.fromkeys(misfits(here, there)))

    def _is_mine(self, session: str) -> bool:
        return self._side is not None and session == self._side.id

    # -- reports to ROS 2 ------------------------------------------------------------------------

    @on(topics.DETECTION)
    def detection(self, report: DetectionReport, header: Header) -> None:
        """Report a change of a detection at once."""
        self._reported(header.source, report)

    @on(topics.RECOVERY)
    def recovery(self, report: RecoveryReport, header: Header) -> None:
        """Report a change of a recovery at once."""
        self._reported(header.source, report)

    def _reported(self, name: str, report: DetectionReport | RecoveryReport) -> None:
        diagnostics, now_s = self._diagnostics, self.clock.now()
        if (diagnostics is not None and diagnostics.take(name, report, now_s)
                and self.time.is_known):
            diagnostics.publish(now_s)

    @on(topics.DECISION)
    def decision(self, record: DecisionRecord, _header: Header) -> None:
        """Report a decision."""
        if self._diagnostics is not None:
            self._diagnostics.decided(record)


def _types(parameters: Gateway.Parameters) -> Types:
    try:
        return types_of(parameters.distribution, parameters.interfaces)
    except ValueError as error:
        raise ValueError(f"parameters.interfaces: {error}") from None


@contextlib.contextmanager
def _named(link: Ros2Link) -> Iterator[None]:
    """Put the name of the row before the text of an error."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"ros2 {link.name}: {error}") from None
