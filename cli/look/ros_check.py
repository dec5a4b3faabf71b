"""`rampart ros2 check`: a system beside the graph of ROS 2.

Over Zenoh it joins the graph as a session without a node, which is invisible there; by a relay, as
a hidden node. It publishes nothing.
"""

from __future__ import annotations

import argparse
import asyncio
import socket
import ssl
import time
from collections import Counter
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from typing import Any

import msgspec

from rampart.actors.ros2.gateway import Gateway, types_of
from rampart.actors.ros2.relay_side import RelayError, RelaySide
from rampart.actors.ros2.ros_nodes import RosNodes
from rampart.actors.ros2.side import Tls, ZenohSide
from rampart.actors.ros2.translation.tables import GATEWAY, Ros2Link
from rampart.actors.ros2.translation.types import DISTRIBUTIONS, Types
from rampart.actors.ros2.wire import (
    ADMIN,
    Endpoint,
    EndpointKind,
    Qos,
    RosGraph,
    data_key,
    dds_name,
    misfits,
)
from rampart.actors.system.members import load_member
from rampart.cli import systems
from rampart.cli.output import NoEffectError, UsageError, print_rows
from rampart.manager.spec.schema import SystemSpec

RELAY = "rclpy"
"""In place of a router's endpoint: the middleware of the environment."""

_LINK_S = 3.0
_RELAY_S = 20.0
_GRAPH_S = 1.0
_DISCOVERY_S = 3.0
"""Fast DDS was seen to take 2.4 s to find a node of the same machine."""

_NODE = "_rampart"
"""Node of a relay that looks on; `ros2 node list` leaves out names with `_` before them."""

_WHY: dict[type[OSError], str] = {
    ConnectionRefusedError: "connection refused; `ros2 run rmw_zenoh_cpp rmw_zenohd` starts one",
    TimeoutError: "no answer; the machine is off, or a firewall drops packets"}


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
async def onlooker(connect: tuple[str, ...], domain: int, distribution: str = "", setup: str = "",
                   tls: Tls | None = None) -> AsyncIterator[Onlooker]:
    """Yield a session that has received the graph.

    Args:
        connect: endpoints of routers; `(RELAY,)` for a relay.
        domain: domain of ROS.
        distribution: of the relay.
        setup: of the relay, see `RelaySide`.
        tls: files for endpoints "tls/…".

    Raises:
        UsageError: an endpoint is invalid, or there is no relay.
        NoEffectError: no router answers.
    """
    is_relayed, lost = connect == (RELAY,), list[RelayError]()
    try:
        side = (RelaySide(_NODE, "/", domain, distribution, setup, lost=lost.append, whole=True,
                          first_s=_RELAY_S) if is_relayed
                else ZenohSide(connect, asyncio.get_running_loop(), tls=tls))
    except RelayError as error:
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
                    "; ".join(f"no router of ROS 2 at {one}: {_refusal(one, tls)}"
                              for one in connect))
            await asyncio.sleep(0.02)
        await asyncio.sleep(_DISCOVERY_S if is_relayed else _GRAPH_S)
        yield found
    finally:
        side.close()


def _refusal(endpoint: str, tls: Tls | None) -> str:
    """Return why a router does not admit this machine."""
    protocol, _, address = endpoint.partition("/")
    host, _, port = address.partition("#")[0].rpartition(":")
    if protocol not in {"tcp", "tls"} or not port.isdecimal():
        return "it does not answer"
    host = host.strip("[]")
    try:
        plain = socket.create_connection((host, int(port)), _LINK_S)
    except OSError as error:
        return _WHY.get(type(error), str(error.strerror or error).lower())
    with plain:
        return _refusal_of_tls(plain, host, tls)


def _refusal_of_tls(plain: socket.socket, host: str, tls: Tls | None) -> str:
    if tls is not None:
        context = tls.context()
    else:
        context = ssl.create_default_context()
        context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    try:
        with context.wrap_socket(plain, server_hostname=host) as secure:
            if tls is None:
                return "it requires TLS: expected connect = ['tls/…'] and tls = { ca = 'FILE' }"
            secure.recv(1)  # a router refuses a certificate after the handshake of TLS 1.3
    except ssl.SSLCertVerificationError as error:
        return f"its certificate is refused: {error.verify_message}"
    except OSError as error:
        if tls is not None and isinstance(error, ssl.SSLError) and error.reason:
            return f"it refuses TLS: {error.reason.lower().replace('_', ' ')}"
    return f"a program listens there, but not a router of Zenoh with{'' if tls else 'out'} TLS"


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
    well = all(one.well for one in found)
    print_rows(("", "what", "how it is"), [
        ("ok" if one.well else "!", one.what, one.why) for one in found],
        {"system": spec.name, "findings": found, "well": well}, as_json=options.json)
    return 0 if well else 1


async def _checked(name: str, gateway: Gateway.Parameters, spec: SystemSpec) -> list[Finding]:
    relay = gateway.middleware == RELAY
    connect = (RELAY,) if relay else gateway.connect
    try:
        async with onlooker(connect, gateway.domain, gateway.distribution, gateway.setup,
                            gateway.tls) as there:
            found = [Finding(f"{'relay' if relay else 'router'} of {name}", True,
                             ", ".join(connect))]
            if isinstance(there.side, RelaySide):
                there.side.look_for(one.type for one in gateway.ros2)
                await asyncio.sleep(_GRAPH_S)
                found += [Finding("types", False, why) for why in there.side.problems]
            found += [Finding("graph", False, odd) for odd in sorted(there.odd)]
            types = types_of(gateway.distribution, gateway.interfaces)
            found += [Finding(kind, True, note) for kind, note in types.notes.items()]
            node = Endpoint(gateway.domain, "0", "0", "0", EndpointKind.NODE, gateway.node,
                            gateway.namespace)
            is_client = gateway.mode == "client"
            if not relay and set(there.graph.nodes()) <= {node.full_name}:
                found.append(Finding("graph", False, await _why_empty(there, gateway.domain)))
            unlinked = set() if relay or is_client else await _unlinked(there, gateway)
            links = [_of_link(link, there.graph, node, types, unlinked) for link in gateway.ros2]
            if isinstance(there.side, ZenohSide) and is_client:
                links = await _passed(there.side, gateway, types, links)
            found += links
            known = there.graph.nodes()
    except NoEffectError as error:
        return [Finding(f"{'relay' if relay else 'router'} of {name}", False, str(error))]
    watched = [one for row in spec.detections
               if row.actor == f"{RosNodes.__module__}:{RosNodes.__name__}"
               for one in row.parameters.get("nodes", ()) if row.parameters["gateway"] == name]
    return found + [Finding(one, one in known, "it is there" if one in known else
                            "no node of this name is in the graph") for one in watched]


_OURS = {"subscribe": EndpointKind.SUBSCRIPTION, "publish": EndpointKind.PUBLISHER,
         "call": EndpointKind.CLIENT}
_THEIRS = {"subscribe": EndpointKind.PUBLISHER, "publish": EndpointKind.SUBSCRIPTION,
           "call": EndpointKind.SERVICE}
_MISSING = {"subscribe": "no node publishes it", "publish": "no node subscribes to it",
            "call": "no node serves it", "goal": "no server of this action"}


async def _why_empty(there: Onlooker, domain: int) -> str:
    domains: Counter[str] = Counter()
    there.side.tokens(f"{ADMIN}/**", lambda token, _: domains.update(
        token.split("/")[1:2] if f"/{EndpointKind.NODE}/" in token else ()))
    await asyncio.sleep(_GRAPH_S)
    domains.pop(str(domain), None)
    why = (f"ROS_DOMAIN_ID is {' or '.join(sorted(domains))} on the robot" if domains else
           f"none runs, or an access rule of the router denies liveliness on {ADMIN}/{domain}/**")
    return f"no node in domain {domain}: {why}"


async def _unlinked(there: Onlooker, gateway: Gateway.Parameters) -> set[str]:
    """Return the sessions in the graph to which a peer finds no direct link."""
    side = ZenohSide(gateway.connect, asyncio.get_running_loop(), mode="peer", tls=gateway.tls)
    await asyncio.sleep(_GRAPH_S)
    try:
        return {one.session for one in there.graph.of(*EndpointKind)} - side.links()
    finally:
        side.close()


async def _passed(side: ZenohSide, gateway: Gateway.Parameters, types: Types,
                  links: list[Finding]) -> list[Finding]:
    """Return the findings with those added that rules of the router cause.

    A router with a rule against a message drops it without an answer. But it then hides the other
    side of a topic, which the graph shows.
    """
    second = ZenohSide(gateway.connect, asyncio.get_running_loop(), tls=gateway.tls)
    counts: Counter[str] = Counter()
    keys = {}
    for link, finding in zip(gateway.ros2, links, strict=True):
        if finding.well:
            topic, kind = _exchanged(link)
            keys[finding.what] = key = data_key(gateway.domain, topic, dds_name(kind),
                                                types.hash(kind))
            if link.way == "subscribe":
                second.subscribe(key, Qos(), lambda *_, what=finding.what: counts.update([what]))
    await asyncio.sleep(_GRAPH_S)

    async def checked(link: Ros2Link, finding: Finding) -> Finding:
        key = keys.get(finding.what)
        if key is None or counts[finding.what] or await side.finds(
                key, service=link.way in {"call", "goal"}):
            return finding
        return msgspec.structs.replace(finding, well=False, why=(
            f"{finding.why}, but an access rule of the router denies {key}"))

    try:
        return await asyncio.gather(*map(checked, gateway.ros2, links))
    finally:
        second.close()


def _exchanged(link: Ros2Link) -> tuple[str, str]:
    """Return topic or service of a link, and its type."""
    if link.way == "goal":
        return f"{link.name}/_action/send_goal", f"{link.type}_SendGoal"
    return link.name, link.type


def _of_link(link: Ros2Link, graph: RosGraph, node: Endpoint, types: Types, unlinked: set[str]
             ) -> Finding:
    way = link.way
    what = f"{way} {link.name}"
    topic, kind = _exchanged(link)
    way = "call" if way == "goal" else way
    mine = msgspec.structs.replace(
        node, kind=_OURS[way], topic=topic, type=dds_name(kind), hash=types.hash(kind),
        qos=Qos(link.reliable, link.transient_local, depth=link.depth))
    there = [one for one in graph.on(topic, _THEIRS[way])
             if one.full_name != node.full_name]
    if link.publisher and there:
        found = ", ".join(one.full_name for one in there)
        there = [one for one in there if one.full_name == link.publisher]
        if not there:
            return Finding(what, False, f"published by {found}; expected {link.publisher}")
    if not there:
        return Finding(what, False, _MISSING[link.way])
    if problems := list(dict.fromkeys(misfits([mine], there))):
        return Finding(what, False, problems[0] + _fitting(mine, kind, there))
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


def _fitting(mine: Endpoint, kind: str, there: list[Endpoint]) -> str:
    """Return which distribution would fit, if the definitions differ."""
    hashes = {one.hash for one in there if one.type == mine.type} - {mine.hash}
    fitting = []
    for name in DISTRIBUTIONS if hashes else ():
        with suppress(ValueError):  # it does not have the type
            if types_of(name, ()).hash(kind) in hashes:
                fitting.append(f"'{name}'")
    return f" {' or '.join(fitting)} has this definition" if fitting else ""
