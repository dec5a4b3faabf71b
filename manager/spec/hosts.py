"""The machines of a system, and what is assumed of the network between them.

A system without a `[[host]]` runs on one machine. Of several the first is the robot's: it decides
who is to run what, gives the others their time, and takes over what a machine ran that cannot be
reached any more (`rampart.actors.supervision.placement`).
"""

from __future__ import annotations

import ipaddress
from collections.abc import Iterator
from itertools import combinations
from typing import TYPE_CHECKING, Annotated

import msgspec

from rampart.manager.spec.tables import Finding, Name, Positive, Table, numbered, unknown

if TYPE_CHECKING:
    from rampart.manager.spec.schema import DetectionSpec, NodeSpec, RecoverySpec, SystemSpec

PORTS = 3
"""Of a host: its two routers, and where the robot's launcher is asked by the others'."""


class HostSpec(Table, frozen=True):
    """A machine.

    Attributes:
        name: By which nodes say that they run there.
        address: IP address of it, as the others reach it.
        port: The first of the three TCP ports that it uses.
    """

    name: Name
    address: str
    port: Annotated[int, msgspec.Meta(ge=1024, le=65_535 - PORTS)] = 7460


class Link(Table, frozen=True):
    """What is assumed of the network between hosts, and when it counts as lost; real seconds.

    Attributes:
        delay_s: Longest time that a message takes while the link is up, what is lost and sent
            again included.
        clock_s: How far the clocks of two hosts may be apart; one that is not known as well as
            that is told of.
        lost_after_s: Nothing was heard of a host for so long: it is lost, and what it ran is
            started on the first host.
        return_after_s: A host has been heard for so long without a break: what was started in its
            place is its own again.
    """

    delay_s: Positive = 0.3
    clock_s: Positive = 0.05
    lost_after_s: Positive = 0.6
    return_after_s: Positive = 3.0


def find_wrong_hosts(spec: SystemSpec) -> Iterator[Finding]:
    """Find hosts that make no sense, and nodes that cannot be where they are."""
    yield from _wrong_table(spec)
    known = [host.name for host in spec.hosts]
    for path, one in _placed(spec):
        if one.host and not known:
            yield Finding(f"{path}.host", "there is no [[host]]", (one.host,))
        elif one.host and one.host not in known:
            yield unknown(f"{path}.host", one.host, "host", known)
    if not known:
        return
    at: dict[str, tuple[str, str]] = {}
    for path, one in _placed(spec):
        host = one.host or known[0]
        first, other = at.setdefault(one.process or one.name, (host, one.name))
        if host != first:
            yield Finding(f"{path}.host", f"{other} lives in the same process, on {first}", (host,))
    for path, node in numbered("node", spec.nodes):
        if node.kind == "pilot" and node.host not in ("", known[0]):
            yield Finding(f"{path}.host", f"{node.name} moves the robot, so no link may be between "
                          f"them; {known[0]!r}, the first host, is right", (node.host,))
    yield from _too_short(spec)


def _placed(spec: SystemSpec) -> Iterator[tuple[str, NodeSpec | DetectionSpec | RecoverySpec]]:
    yield from numbered("node", spec.nodes)
    yield from numbered("detection", spec.detections)
    yield from numbered("recovery", spec.recoveries)


def _wrong_table(spec: SystemSpec) -> Iterator[Finding]:
    if len(spec.hosts) == 1:
        yield Finding("$.host", "one machine needs no [[host]]; leave it out, or name another one")
    for path, host in numbered("host", spec.hosts):
        try:
            ipaddress.ip_address(host.address)
        except ValueError:
            yield Finding(f"{path}.address", "expected an IP address such as '192.168.7.1'",
                          (host.address,))
    for (_, one), (path, other) in combinations(numbered("host", spec.hosts), 2):
        if one.name == other.name:
            yield Finding(f"{path}.name", "duplicate name", (other.name,))
        if one.address == other.address and abs(one.port - other.port) < PORTS:
            yield Finding(f"{path}.port", f"each host uses {PORTS} ports, and {one.name} has the "
                          f"same address and those from {one.port}", (other.port,))


def _too_short(spec: SystemSpec) -> Iterator[Finding]:
    """Find detection modules that would take the link's delay for silence."""
    needed_s = spec.link.delay_s + 2 * spec.timing.heartbeat_period_s
    host_of = spec.host_of
    for path, detection in numbered("detection", spec.detections):
        far = [name for name in detection.watch if host_of[name] != host_of[detection.name]]
        timeout_s = detection.parameters.get("timeout_s", needed_s)
        if far and isinstance(timeout_s, int | float) and timeout_s < needed_s:
            yield Finding(f"{path}.parameters.timeout_s", f"{detection.name} watches {far[0]} over "
                          f"the link: two heartbeats and [link] delay_s, {needed_s:.2f} s, is the "
                          "least", (timeout_s,))
