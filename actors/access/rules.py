"""The access rules that a router enforces, as Zenoh's `access_control`.

Nothing but what they allow is let through.

A router knows who is at the other end of a link by the name in its certificate, and looks at each
message that comes in by the link and each that goes out. Names are literal to Zenoh, so a rule is
written for each identity.

* A client gets its own rights (`rampart.actors.access.rights`).
* The other router of the same host gets everything: it has checked what it hands on.
* A router of another host gets what the nodes there and people may do together. What it says
  beyond that is refused, whoever it claims to hand it on for.

Going out, besides what somebody hears, is who else hears and asks: a publisher that did not know
would not send. So of all subscriptions and questions of the system those go out that meet what the
other end may say.
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
"""All that is ever let through; of what Zenoh can refuse, liveliness tokens and deleting never."""

Grant = tuple[str, tuple[str, ...], frozenset[str]]
"""Flow, messages, and the key expressions for which they are let through."""


@dataclass(frozen=True, slots=True)
class Host:
    """One machine of a system, on which tools of operators and viewers may be used too.

    Attributes:
        name: of it; "" where there is one only.
        routers: names of its routers.
        nodes: names of the other processes there that have certificates.
    """

    name: str = ""
    routers: tuple[str, ...] = ROUTERS
    nodes: frozenset[str] = frozenset()


_parsed = cache(zenoh.KeyExpr)


def _meet(those: Iterable[str], these: Iterable[str]) -> frozenset[str]:
    """Return those of the first that have a key in common with one of the second."""
    wanted = [_parsed(key) for key in these]
    return frozenset(key for key in those
                     if any(_parsed(key).intersects(one) for one in wanted))


def grants(own: Rights, everybody: Rights) -> list[Grant]:
    """Return what a router lets through on a link to somebody.

    Args:
        own: what that one may.
        everybody: what all of the system may.
    """
    found: list[Grant] = [
        (INGRESS, (PUT,), own.says),
        (INGRESS, (SUBSCRIBER,), own.hears),
        (INGRESS, (QUERY,), own.asks),
        (INGRESS, (QUERYABLE, REPLY), own.answers),
        (EGRESS, (PUT,), own.hears),
        (EGRESS, (SUBSCRIBER,), _meet(everybody.hears, own.says)),
        (EGRESS, (QUERY,), _meet(everybody.asks, own.answers)),
        (EGRESS, (QUERYABLE,), _meet(everybody.answers, own.asks)),
        (EGRESS, (REPLY,), own.asks)]
    return [grant for grant in found if grant[2]]


_BETWEEN_ROUTERS: list[Grant] = [
    (flow, MESSAGES, frozenset({EVERYTHING}))
    for flow in (INGRESS, EGRESS)]


def config_of(granted: Mapping[str, Iterable[Grant]]) -> dict[str, Any]:
    """Return Zenoh's `access_control`, of what is let through by the names in certificates."""
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
    """Return what the routers of a host let through, by the names in certificates.

    Args:
        host: theirs.
        hosts: all of the system, this one among them.
        rights: of all, see `rights_of_all`.
        register: who has which certificate; nobody else may anything.
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
    """Return the hosts of a system by name; "" is the first, which may run what others do."""
    hosts = layout.hosts
    return {name: Host(name, hosts.routers_of(name), hosts.may_run(name, layout.members))
            for name in hosts.supervisors}


def access_of(layout: Layout, keys: str) -> dict[str, Any]:
    """Return what the routers of a run on this host let through, as Zenoh's `access_control`.

    Args:
        layout: of the run.
        keys: folder of keys, with the register as it is now.

    Raises:
        KeysError: there is no sound register.
    """
    hosts = hosts_of(layout)
    return config_of(rules_of(hosts[layout.plan.host], list(hosts.values()), rights_of_all(layout),
                              read_register(Path(keys))))
