"""Access rules, pair by pair, beside what the classes declare.

The rules are read as a router reads them: from Zenoh's configuration, by the name in a certificate.
What is declared is asked of each class, key by key, and not taken from where the rules come from.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import msgspec
import zenoh

from rampart.actors.access.register import Register
from rampart.actors.access.rights import OPERATOR, VIEWER, rights_of_all
from rampart.actors.access.rules import config_of, hosts_of, rules_of
from rampart.actors.bus.topic import ROOT, Members, Qos, Topic
from rampart.actors.bus.topics import INJECT
from rampart.actors.runtime.actor import BASE_INPUTS, BASE_OUTPUTS
from rampart.actors.runtime.run_plan import OBSERVER
from rampart.actors.system.layout import Layout, router
from rampart.actors.system.members import Member
from rampart.actors.system.topics import declared_topics

PEOPLE = ("operator", "viewer")

_FOREIGN = ("nothing/declared", "**", "*/*", "heartbeat/*", "alive/DM5/1")
"""What nobody declares; as keys, expressions with wildcards included."""

_CLAIMS = (
    ("ingress", "put", "says"), ("ingress", "declare_subscriber", "hears"),
    ("egress", "put", "hears"), ("ingress", "declare_queryable", "answers"),
    ("ingress", "reply", "answers"), ("ingress", "query", "asks"), ("egress", "reply", "asks"),
    ("ingress", "liveliness_token", "never"), ("ingress", "delete", "never"),
    ("egress", "delete", "never"))
"""Flow, message, and whether that is to say, to hear, to answer, to ask, or nothing."""


def disagreements(layout: Layout, config: Mapping[str, Any]) -> tuple[list[str], dict[str, set]]:
    """Compare what the routers of a layout's host let through with what is declared.

    Returns what is let through and not declared, or the other way round; and who may publish on
    each key.
    """
    declared = Declared(layout)
    keys = {key: zenoh.KeyExpr(f"{ROOT}/{key}") for key in dict.fromkeys(declared.keys())}
    wrong: list[str] = []
    speakers: dict[str, set[str]] = {}
    for name in declared.identities:
        for flow, message, what in _CLAIMS:
            lets = _let_through(config, name, flow, message)
            for key, expression in keys.items():
                may = lets(expression)
                if may and (flow, message) == ("ingress", "put"):
                    speakers.setdefault(key, set()).add(name)
                if may != declared.may(name, what, key):
                    wrong.append(f"{name}: {message} of {key!r} ({flow}) is " + (
                        "let through, and not declared" if may else "declared, and refused"))
    return wrong, speakers


def rules_as_declared(layout: Layout) -> dict[str, Any]:
    """Return what routers let through if each process has a certificate of its own name.

    And an operator and a viewer, called so.
    """
    hosts = hosts_of(layout)
    register = Register().issued([OPERATOR], OPERATOR).issued([VIEWER], VIEWER)
    for host in hosts.values():
        register = register.issued(host.routers, "router").issued(sorted(host.nodes), "node")
    return config_of(rules_of(hosts[layout.plan.host], list(hosts.values()), rights_of_all(layout),
                              register))


def on_each_host(layout: Layout) -> Iterator[Layout]:
    """Yield a layout as each of its hosts has it."""
    for host in layout.hosts.supervisors:
        yield Layout(msgspec.structs.replace(layout.plan, host=host), layout.spec)


def _let_through(config: Mapping[str, Any], common_name: str, flow: str,
                 message: str) -> Callable[[zenoh.KeyExpr], bool]:
    """Return whether a router lets a message through on a key, by the name in a certificate."""
    if not config["enabled"]:
        return lambda _key: True
    subjects = {subject["id"] for subject in config["subjects"]
                if common_name in subject.get("cert_common_names", [common_name])}
    chosen = {rule for policy in config["policies"] if subjects & set(policy["subjects"])
              for rule in policy["rules"]}
    found: dict[str, list[str]] = {"allow": [], "deny": []}
    for rule in config["rules"]:
        if rule["id"] in chosen and flow in rule["flows"] and message in rule["messages"]:
            found[rule["permission"]] += rule["key_exprs"]
    by_default = config["default_permission"] == "allow"
    denies, allows = _includer(found["deny"]), _includer(found["allow"])
    return lambda key: not denies(key) and (by_default or allows(key))


def _includer(expressions: list[str]) -> Callable[[zenoh.KeyExpr], bool]:
    literal = {one for one in expressions if "*" not in one}
    wide = [zenoh.KeyExpr(one) for one in expressions if "*" in one]
    return lambda key: str(key) in literal or any(one.includes(key) for one in wide)


class Declared:
    """What the classes of a system declare, asked key by key."""

    def __init__(self, layout: Layout) -> None:
        hosts = layout.hosts
        self._own = layout.plan.host
        routers = {name: host for host in hosts.supervisors for name in hosts.routers_of(host)}
        self._members = {**layout.members, **{name: router(name) for name in routers}}
        self._may_run = {host: {*hosts.may_run(host, layout.members), *hosts.routers_of(host)}
                         for host in hosts.supervisors}
        self._far = {name: host for name, host in routers.items() if host != self._own}
        self.identities = (*layout.members, *self._far, *PEOPLE)
        self._pages = [m for m in layout.members.values() if m.actor.is_page]
        self._names = [*routers, *layout.members]
        every = (*declared_topics(layout.spec), *BASE_OUTPUTS, *BASE_INPUTS,
                 *layout.topics.values(),
                 *(t for m in (*layout.members.values(), *map(router, routers))
                   for t in (*m.actor.outputs, *m.actor.inputs())))
        self._topics = {topic.key: topic for topic in every}

    def keys(self) -> Iterator[str]:
        """Yield all keys that there are, below the root."""
        for topic in self._topics.values():
            for name in self._names if topic.is_family else ("",):
                yield topic.key.replace("{name}", name)
        for member in self._members.values():
            yield from member.actor.own_keys(member.parameters)
        yield from _FOREIGN

    def may(self, identity: str, what: str, key: str) -> bool:
        """Return whether an identity declares that it says, hears, ... on a key.

        The routers of another host do for all that may run there, and for people; who runs
        elsewhere has no link to a router of this host.
        """
        if identity in self._far:
            return any(self._may(one, what, key)
                       for one in (*self._may_run[self._far[identity]], *PEOPLE))
        return (identity in self._may_run[self._own] or identity in PEOPLE) and (
            self._may(identity, what, key))

    def _may(self, identity: str, what: str, key: str) -> bool:
        if what == "never":
            return False
        of_person, kept = identity in PEOPLE, self._is_kept(key)
        if what == "answers":
            return not of_person and kept and _says(self._members[identity], key)
        if what == "asks":
            return (of_person or kept) and self._hears(identity, key)
        if what == "hears" and identity == OBSERVER and len(self._may_run) > 1:
            return True  # its recorder does
        return (self._says if what == "says" else self._hears)(identity, key)

    def _says(self, identity: str, key: str) -> bool:
        if identity in PEOPLE:
            return identity == "operator" and self._is_operated(key)
        member = self._members[identity]
        return (key in member.actor.own_keys(member.parameters) or _says(member, key)
                or (identity == OBSERVER and self._is_operated(key)))

    def _hears(self, identity: str, key: str) -> bool:
        if identity in PEOPLE:
            return True
        member = self._members[identity]
        return key in member.actor.own_keys(member.parameters) or _hears(member, key)

    def _is_operated(self, key: str) -> bool:
        if any(topic.member(key) is not None for topic in BASE_OUTPUTS):
            return False
        return key == INJECT.key or any(_says(page, key) for page in self._pages) or any(
            topic.outside and topic.qos is Qos.COMMAND and topic.key == key
            for topic in self._topics.values())

    def _is_kept(self, key: str) -> bool:
        return any(topic.member(key) is not None and topic.qos is not Qos.COMMAND
                   for topic in self._topics.values())


def _says(member: Member, key: str) -> bool:
    return member.actor.published(key, member.name, member.parameters) is not None or (
        _is_chosen(member.publishes, key))


def _hears(member: Member, key: str) -> bool:
    def names(topic: Topic[Any]) -> Members:
        return member.actor.names(topic, member.name, member.parameters)

    for topic in (*member.actor.inputs(), *BASE_INPUTS):
        one = topic.member(key)
        if one is not None and (not one or (chosen := names(topic)) is None or one in chosen):
            return True
    return _is_chosen(member.hears, key)


def _is_chosen(chosen: Mapping[str, Members], key: str) -> bool:
    for topic, names in chosen.items():
        head, family, tail = topic.partition("{name}")
        name = key[len(head):len(key) - len(tail)]
        if key == (f"{head}{name}{tail}" if family else topic) and (
                not family or names is None or name in names):
            return bool(name) or not family
    return False
