"""`rampart topic … --ros` and `rampart ros2 check`: the graph of ROS 2.

Over Zenoh they join the graph as a session without a node, which is invisible there; by a relay, as
a hidden node. They publish nothing.
"""

from __future__ import annotations

import argparse
import asyncio
import os
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import msgspec

from rampart.actors.ros2.gateway import Gateway, types_of
from rampart.actors.ros2.graph import RosGraph, misfits
from rampart.actors.ros2.relay_side import RelayError, RelaySide
from rampart.actors.ros2.ros_nodes import RosNodes
from rampart.actors.ros2.side import ZenohSide
from rampart.actors.ros2.translation.fields import plain
from rampart.actors.ros2.translation.tables import GATEWAY, Ros2Link
from rampart.actors.ros2.translation.types import DISTRIBUTIONS, Types
from rampart.actors.ros2.wire import (
    ADMIN,
    UNKNOWN_HASH,
    Attachment,
    Endpoint,
    EndpointKind,
    Qos,
    dds_name,
    ros_name,
)
from rampart.actors.system.members import load_member
from rampart.cli import systems
from rampart.cli.look.topic_lines import in_line, print_rate, rate_of
from rampart.cli.output import NoEffectError, UsageError, print_json, print_table, say, warn
from rampart.manager.spec.schema import SystemSpec

DOMAIN, DISTRIBUTION = "ROS_DOMAIN_ID", "ROS_DISTRO"
"""Variables of ROS 2."""

RELAY = "rclpy"
"""In place of a router's endpoint: the middleware of the environment."""

_LINK_S = 3.0
_RELAY_S = 20.0
_GRAPH_S = 1.0
_DISCOVERY_S = 3.0
"""Fast DDS was seen to take 2.4 s to find a node of the same machine."""

_NODE = "_rampart"
"""Node of a relay that looks on; `ros2 node list` leaves out names with `_` before them."""

_TOPICS = (EndpointKind.PUBLISHER, EndpointKind.SUBSCRIPTION)


class Onlooker:
    """A session that receives the graph of a domain.

    Args:
        side: the network.
        domain: domain of ROS.

    Attributes:
        side: the network.
        graph: nodes and endpoints.
        odd: problems with tokens that cannot be read.
    """

    def __init__(self, side: ZenohSide | RelaySide, domain: int) -> None:
        self.side, self.graph, self.odd = side, RosGraph(), set[str]()
        side.tokens(f"{ADMIN}/{domain}/**", self._changed)

    def _changed(self, token: str, alive: bool) -> None:
        try:
            self.graph.changed(token, alive)
        except ValueError as error:
            self.odd.add(str(error))


@asynccontextmanager
async def onlooker(connect: tuple[str, ...], domain: int, distribution: str = "", setup: str = ""
                   ) -> AsyncIterator[Onlooker]:
    """Yield a session that has received the graph.

    Args:
        connect: endpoints of routers; `(RELAY,)` for a relay.
        domain: domain of ROS.
        distribution: of the relay.
        setup: of the relay, see `RelaySide`.

    Raises:
        UsageError: an endpoint is invalid, or there is no relay.
        NoEffectError: no router answers.
    """
    is_relayed, lost = connect == (RELAY,), list[RelayError]()
    try:
        side = (RelaySide(_NODE, "/", domain, distribution, setup, lost=lost.append, whole=True,
                          first_s=_RELAY_S) if is_relayed
                else ZenohSide(connect, asyncio.get_running_loop()))
    except (ValueError, RelayError) as error:
        raise UsageError(str(error)) from None
    try:
        found = Onlooker(side, domain)
        until_s = time.monotonic() + (_RELAY_S if is_relayed else _LINK_S)
        while not side.is_linked():
            if lost:
                raise UsageError(str(lost[0]))
            if time.monotonic() > until_s:
                raise NoEffectError(
                    f"the relay to ROS 2 has not started in {_RELAY_S:g} s" if is_relayed else
                    f"no router of ROS 2 at {', '.join(connect)}; "
                    "`ros2 run rmw_zenoh_cpp rmw_zenohd` starts one")
            await asyncio.sleep(0.02)
        await asyncio.sleep(_DISCOVERY_S if is_relayed else _GRAPH_S)
        yield found
    finally:
        side.close()


def domain_of_environment() -> int:
    """Return the domain of the environment, 0 by default.

    Raises:
        UsageError: it is not a domain.
    """
    domain = os.environ.get(DOMAIN, "0")
    if not (domain.isascii() and domain.isdecimal() and len(domain) < 4):
        raise UsageError(f"{DOMAIN}={domain}: expected a number from 0 to 232")
    return int(domain)


def distribution() -> str:
    """Return the distribution of the environment, by default Jazzy.

    Raises:
        UsageError: the distribution is unknown.
    """
    name = os.environ.get(DISTRIBUTION, "jazzy")
    if name not in DISTRIBUTIONS:
        raise UsageError(f"{DISTRIBUTION}={name}: unknown; known: {', '.join(DISTRIBUTIONS)}")
    return name


async def list_topics(options: argparse.Namespace) -> int:
    """Print the topics of ROS 2, as `rampart topic list` does."""
    async with onlooker((options.ros,), domain_of_environment(), distribution()) as there:
        found = [_described(topic, ends) for topic, ends in there.graph.topics().items()]
    if options.json:
        print_json(found)
    else:
        print_table(("topic", "type", "publishers", "subscribers"), [
            (row["topic"], ", ".join(row["types"]), ", ".join(row["publishers"]) or "-",
             ", ".join(row["subscribers"]) or "-") for row in found])
    return 0


def _described(topic: str, ends: list[Endpoint]) -> dict[str, Any]:
    return {"topic": topic, "types": sorted({ros_name(one.type) for one in ends}),
            **{f"{word}s": sorted({one.full_name for one in ends if one.kind is kind})
               for kind, word in zip(_TOPICS, ("publisher", "subscriber"), strict=True)}}


async def echo(options: argparse.Namespace) -> int:
    """Print messages of ROS 2, as `rampart topic echo` does."""
    done, seen = asyncio.Event(), 0

    def heard(message: Any, attachment: Attachment) -> None:
        nonlocal seen
        seen += 1
        if options.count is not None and seen > options.count:
            return
        if options.json:
            print_json({"topic": options.key, "sent_ns": attachment.stamp_ns,
                        "sequence": attachment.sequence, "message": plain(message)}, indent=False)
        else:
            say(f"{attachment.stamp_ns / 1e9:.3f} {options.key} {in_line(plain(message))}")
        if options.count is not None and seen >= options.count:
            done.set()

    await _receive(options, heard, done)
    if not seen:
        raise NoEffectError(f"no message on {options.key}")
    return 0


async def measure(options: argparse.Namespace) -> int:
    """Measure rates of ROS 2 in real time, as `rampart topic hz` does."""
    times: list[float] = []
    await _receive(options, lambda _message, _attachment: times.append(time.monotonic()),
                asyncio.Event(), times=None if options.json else times,
                duration_s=options.duration or (3.0 if options.json else None))
    if options.json:
        print_json([{"topic": options.key, **rate_of(times[-500:])}])
    if not times:
        raise NoEffectError(f"no message on {options.key}")
    return 0


async def _receive(options: argparse.Namespace, heard: Any, done: asyncio.Event, *,
                   times: list[float] | None = None, duration_s: float | None = None) -> None:
    """Receive a topic until `done`, the end of the duration, or an interruption."""
    domain, types = domain_of_environment(), Types(distribution())
    duration_s = duration_s or options.duration
    async with onlooker((options.ros,), domain, types.distribution) as there:
        ends = there.graph.on(options.key, EndpointKind.PUBLISHER)
        if not ends:
            known = ", ".join(there.graph.topics()) or "none"
            raise NoEffectError(f"no node publishes {options.key}; topics: {known}")
        name = ros_name(ends[0].type)
        try:
            decode = types.decoder(name)
            if ends[0].hash not in {types.hash(name), UNKNOWN_HASH}:
                warn(f"{ends[0].full_name} has another definition of {name} than "
                     f"{types.distribution}; set {DISTRIBUTION} to its distribution")
        except ValueError as error:
            raise UsageError(str(error)) from None

        def arrived(payload: bytes, attached: bytes | None) -> None:
            try:
                heard(decode(payload), Attachment.unpack(attached))
            except ValueError as error:
                warn(f"{options.key}: {error}")

        offered = ends[0].qos
        there.side.subscribe(
            ends[0].key, Qos(offered.reliable, offered.transient_local, depth=1), arrived)
        until_s = time.monotonic() + (duration_s or float("inf"))
        while not done.is_set() and time.monotonic() < until_s:
            await asyncio.sleep(1.0 if times is not None else 0.02)
            if times:
                print_rate(options.key, rate_of(times[-500:]))


# -- check ----------------------------------------------------------------------------------------


class Finding(msgspec.Struct, frozen=True):
    """The result of the check of one link or node."""

    what: str
    well: bool
    why: str


async def check(options: argparse.Namespace) -> int:
    """Check a system's gateways against the graph; return 1 if one does not fit."""
    spec = systems.load(options.system or str(systems.DEFAULT))
    if not spec.ros2:
        raise UsageError(f"{spec.name} has no [[ros2]]: a gateway has nothing to pass on")
    found: list[Finding] = []
    for node in spec.nodes:
        if node.actor == GATEWAY:
            gateway: Any = load_member(node, spec, spec.name).parameters
            found += await _checked(node.name, gateway, spec)
    if options.json:
        print_json({"system": spec.name, "findings": found,
                    "well": all(one.well for one in found)})
    else:
        print_table(("", "what", "how it is"), [
            ("ok" if one.well else "!", one.what, one.why) for one in found])
    return 0 if all(one.well for one in found) else 1


async def _checked(name: str, gateway: Gateway.Parameters, spec: SystemSpec) -> list[Finding]:
    relay = gateway.middleware == RELAY
    connect = (RELAY,) if relay else gateway.connect
    try:
        async with onlooker(connect, gateway.domain, gateway.distribution, gateway.setup) as there:
            found = [Finding(f"{'relay' if relay else 'router'} of {name}", True,
                             ", ".join(connect))]
            if isinstance(there.side, RelaySide):
                found += [Finding("types", False, why)
                          for why in await there.side.known(one.type for one in gateway.ros2)]
            found += [Finding("graph", False, odd) for odd in sorted(there.odd)]
            types = types_of(gateway.distribution, gateway.interfaces)
            found += [Finding(kind, True, note) for kind, note in types.notes.items()]
            node = Endpoint(gateway.domain, "0", "0", "0", EndpointKind.NODE, gateway.node,
                            gateway.namespace)
            unlinked = (await _unlinked(there, connect)
                        if gateway.mode == "peer" and not relay else set())
            found += [_of_link(link, there.graph, node, types, unlinked)
                      for link in gateway.ros2]
            known = there.graph.nodes()
    except NoEffectError as error:
        return [Finding(f"{'relay' if relay else 'router'} of {name}", False, str(error))]
    watched = [one for row in spec.detections
               if row.actor == f"{RosNodes.__module__}:{RosNodes.__name__}"
               for one in row.parameters.get("nodes", ()) if row.parameters["gateway"] == name]
    return found + [Finding(one, one in known, "it is there" if one in known else
                            "no node of this name is in the graph") for one in watched]


_OURS = {"subscribe": EndpointKind.SUBSCRIPTION, "publish": EndpointKind.PUBLISHER,
         "call": EndpointKind.CLIENT, "serve": EndpointKind.SERVICE}
_THEIRS = {"subscribe": EndpointKind.PUBLISHER, "publish": EndpointKind.SUBSCRIPTION,
           "call": EndpointKind.SERVICE, "serve": EndpointKind.CLIENT}
_MISSING = {"subscribe": "no node publishes it", "publish": "no node subscribes to it",
            "call": "no node serves it", "serve": "no node calls it yet",
            "goal": "no server of this action"}


async def _unlinked(there: Onlooker, connect: tuple[str, ...]) -> set[str]:
    """Return the sessions in the graph to which a peer finds no direct link."""
    side = ZenohSide(connect, asyncio.get_running_loop(), mode="peer")
    await asyncio.sleep(_GRAPH_S)
    try:
        return {one.session for one in there.graph.of(*EndpointKind)} - side.links()
    finally:
        side.close()


def _of_link(link: Ros2Link, graph: RosGraph, node: Endpoint, types: Types, unlinked: set[str]
             ) -> Finding:
    way = link.way
    what = f"{way} {link.name}"
    topic, kind = link.name, link.type
    if way == "goal":
        topic, kind, way = f"{link.name}/_action/send_goal", f"{link.type}_SendGoal", "call"
    mine = msgspec.structs.replace(
        node, kind=_OURS[way], topic=topic, type=dds_name(kind), hash=types.hash(kind),
        qos=Qos(link.reliable, link.transient_local, depth=link.depth))
    there = [one for one in graph.on(topic, _THEIRS[way])
             if one.full_name != node.full_name]
    if not there:
        return Finding(what, way == "serve", _MISSING[link.way])
    if problems := list(dict.fromkeys(misfits([mine], there))):
        return Finding(what, False, problems[0])
    if far := [one.full_name for one in there if one.session in unlinked]:
        return Finding(what, False, f"{far[0]} is in the graph, but without a link to it: a peer "
                                    'receives nothing by a router; mode = "client" of the gateway '
                                    "exchanges through the router")
    names = ", ".join(dict.fromkeys(one.full_name for one in there))
    if way == "publish":
        others = [one.full_name for one in graph.on(topic, EndpointKind.PUBLISHER)
                  if one.full_name != node.full_name]
        if others:
            return Finding(what, False, f"{others[0]} publishes it too: it moves the robot past "
                                        "every check")
    return Finding(what, True, f"{names}, {link.type}")
