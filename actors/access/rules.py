"""The access rules that a router enforces, as Zenoh's `access_control`.

A router passes only messages that a rule allows.

A router identifies the other end of a link by the name in its certificate. It checks each incoming
and each outgoing message of the link. Zenoh takes names literally, so each identity has rules.

* A client has its own rights (`rampart.actors.access.rights`).
* The other router of the same host may pass everything, because it checks the same rules.
* A router of another host has the rights of the nodes there and of people together.

Subscriptions and queries go out as well, because a publisher sends only to known subscribers. A
link gets those of the whole system that match keys which the other end may publish.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import chain
from pathlib import Path
from typing import Any

import zenoh

from rampart.actors.access.register import Register, read_register
from rampart.actors.access.rights import (
    EVERYTHING,
    OPERATOR,
    VIEWER,
    Rights,
    rights_of_all,
    together,
)
from rampart.actors.bus.run_folder import ROUTERS
from rampart.actors.system.layout import Layout

INGRESS, EGRESS = "ingress", "egress"
PUT, SUBSCRIBER, QUERY, QUERYABLE, REPLY = (
    "put", "declare_subscriber", "query", "declare_queryable", "reply")
MESSAGES = (PUT, SUBSCRIBER, QUERY, QUERYABLE, REPLY)
"""All messages that rules allow. Liveliness tokens and deleting are always refused."""

Grant = tuple[str, tuple[str, ...], frozenset[str]]
"""Flow, messages, and the key expressions for which they may pass."""


@dataclass(frozen=True, slots=True)
class Host:
    """One machine of a system. Operators and viewers may use tools on every machine.

    Attributes:
        name: Name of the machine; "" for the first or only one.
        routers: Names of its routers.
        nodes: Names of its other processes with certificates.
    """

    name: str = ""
    routers: tuple[str, ...] = ROUTERS
    nodes: frozenset[str] = frozenset()


_parsed = cache(zenoh.KeyExpr)


def _overlapping(keys: Iterable[str], others: Iterable[str]) -> frozenset[str]:
    """Return the key expressions that intersect one of the others."""
    wanted = [_parsed(key) for key in others]
    return frozenset(key for key in keys
                     if any(_parsed(key).intersects(other) for other in wanted))


def grants(own: Rights, everybody: Rights) -> list[Grant]:
    """Return the messages that a router passes on a link to one identity.

    Args:
        own: Rights of the identity.
        everybody: Rights of the whole system.
    """
    found: list[Grant] = [
        (INGRESS, (PUT,), own.publishes),
        (INGRESS, (SUBSCRIBER,), own.subscribes),
        (INGRESS, (QUERY,), own.queries),
        (INGRESS, (QUERYABLE, REPLY), own.answers),
        (EGRESS, (PUT,), own.subscribes),
        (EGRESS, (SUBSCRIBER,), _overlapping(everybody.subscribes, own.publishes)),
        (EGRESS, (QUERY,), _overlapping(everybody.queries, own.answers)),
        (EGRESS, (QUERYABLE,), _overlapping(everybody.answers, own.queries)),
        (EGRESS, (REPLY,), own.queries)]
    return [grant for grant in found if grant[2]]


_BETWEEN_ROUTERS: list[Grant] = [
    (flow, MESSAGES, frozenset({EVERYTHING}))
    for flow in (INGRESS, EGRESS)]


def config_of(granted: Mapping[str, Iterable[Grant]]) -> dict[str, Any]:
    """Return Zenoh's `access_control` for grants by the names in certificates."""
    rules = {name: [
        {"id": f"{name} {number}", "permission": "allow", "flows": [flow],
         "messages": list(messages), "key_exprs": sorted(keys)}
        for number, (flow, messages, keys) in enumerate(grants)]
        for name, grants in sorted(granted.items()) if grants}
    return {"enabled": True, "default_permission": "deny",
            "rules": [*chain.from_iterable(rules.values())],
            "subjects": [{"id": name, "cert_common_names": [name]} for name in rules],
            "policies": [{"rules": [rule["id"] for rule in own], "subjects": [name]}
                         for name, own in rules.items()]}


def rules_of(host: Host, hosts: Sequence[Host], rights: Mapping[str, Rights],
             register: Register) -> dict[str, list[Grant]]:
    """Return the grants of a host's routers, by the names in certificates.

    Args:
        host: The host.
        hosts: All hosts of the system, this one included.
        rights: See `rights_of_all`.
        register: Valid identities; all others have no rights.
    """
    everybody = together(rights.values())
    routers, nodes = register.of_kind("router"), register.of_kind("node")
    found: dict[str, list[Grant]] = {}
    for name in host.routers:
        if name in routers:
            found[routers[name]] = _BETWEEN_ROUTERS
    for name in host.nodes:
        if name in nodes:
            found[nodes[name]] = grants(rights[name], everybody)
    for kind in (OPERATOR, VIEWER):
        granted = grants(rights[kind], everybody)
        found.update(dict.fromkeys(register.of_kind(kind).values(), granted))
    for other in hosts:
        if other.name != host.name:
            there = [rights[name] for name in (*other.nodes, *other.routers, OPERATOR, VIEWER)]
            between = grants(together(there), everybody)
            found.update((routers[name], between) for name in other.routers if name in routers)
    return found


def hosts_of(layout: Layout) -> dict[str, Host]:
    """Return the hosts of a system by name; "" is the first, which may run all nodes."""
    hosts = layout.hosts
    return {name: Host(name, hosts.routers_of(name), hosts.may_run(name, layout.members))
            for name in hosts.supervisors}


def access_of(layout: Layout, keys: str) -> dict[str, Any]:
    """Return Zenoh's `access_control` for the routers of a run on this host.

    Args:
        layout: Layout of the run.
        keys: Folder of credentials with the current register.

    Raises:
        KeysError: The register is missing or invalid.
    """
    hosts = hosts_of(layout)
    return config_of(rules_of(hosts[layout.plan.host], list(hosts.values()), rights_of_all(layout),
                              read_register(Path(keys))))
