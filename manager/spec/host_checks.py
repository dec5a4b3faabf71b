"""Whether the machines of a system make sense, and what runs on each."""

from __future__ import annotations

import ipaddress
from collections.abc import Iterator
from itertools import combinations

from rampart.manager.spec.hosts import PORTS
from rampart.manager.spec.nodes import Kind, NodeSpec
from rampart.manager.spec.schema import DetectionSpec, RecoverySpec, SystemSpec
from rampart.manager.spec.tables import Finding, numbered, unknown


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
        if node.kind is Kind.PILOT and node.host not in ("", known[0]):
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
