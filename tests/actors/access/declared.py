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
    every, declared = declared_rights(layout)
    keys = {key: zenoh.KeyExpr(f"{ROOT}/{key}") for key in every}
    wrong: list[str] = []
    speakers: dict[str, set[str]] = {}
    for name, right in declared.items():
        for flow, message, what in _CLAIMS:
            lets = _let_through(config, name, flow, message)
            for key, expression in keys.items():
                may = lets(expression)
                if may and (flow, message) == ("ingress", "put"):
                    speakers.setdefault(key, set()).add(name)
                if may != (key in right.get(what, ())):
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
    assert (config["enabled"], config["default_permission"]) == (True, "deny")
    assert {rule["permission"] for rule in config["rules"]} == {"allow"}
    subjects = {subject["id"] for subject in config["subjects"]
                if common_name in subject["cert_common_names"]}
    chosen = {rule for policy in config["policies"] if subjects & set(policy["subjects"])
              for rule in policy["rules"]}
    keys = [key for rule in config["rules"] for key in rule["key_exprs"]
            if rule["id"] in chosen and flow in rule["flows"] and message in rule["messages"]]
    literal = {one for one in keys if "*" not in one}
    wide = [zenoh.KeyExpr(one) for one in keys if "*" in one]
    return lambda key: str(key) in literal or any(one.includes(key) for one in wide)


Right = dict[str, set[str]]
"""The keys that an identity may say, hear, answer and ask."""


def declared_rights(layout: Layout) -> tuple[list[str], dict[str, Right]]:
    """Return all keys below the root, and by identity what the classes of a system declare.

    A router of another host has the rights of everything that may run there, and of people. A node
    that runs elsewhere has no link to a router of this host.
    """
    hosts = layout.hosts
    routers = {name: host for host in hosts.supervisors for name in hosts.routers_of(host)}
    members = {**layout.members, **{name: router(name) for name in routers}}
    topics = {topic.key: topic for topic in (
        *declared_topics(layout.spec), *BASE_OUTPUTS, *BASE_INPUTS, *layout.topics.values(),
        *(t for m in members.values() for t in (*m.actor.outputs, *m.actor.inputs())))}.values()
    own = {name: set(m.actor.own_keys(m.parameters)) for name, m in members.items()}
    keys = list(dict.fromkeys((
        *(topic.key.replace("{name}", name) for topic in topics
          for name in (members if topic.is_family else ("",))), *set().union(*own.values()),
        *_FOREIGN)))
    kept = {key for key in keys if any(
        topic.member(key) is not None and topic.qos is not Qos.COMMAND for topic in topics)}
    found: dict[str, Right] = {}
    for name, member in members.items():
        says, hears = ({key for key in keys if may(member, key)} for may in (_says, _hears))
        found[name] = {"says": says | own[name], "hears": hears | own[name],
                       "answers": says & kept, "asks": (hears | own[name]) & kept}
    pages = [name for name, member in layout.members.items() if member.actor.is_page]
    outside = {topic.key for topic in topics if topic.outside and topic.qos is Qos.COMMAND}
    operated = {INJECT.key, *outside, *(key for page in pages for key in found[page]["says"] if not
                any(topic.member(key) is not None for topic in BASE_OUTPUTS))}
    found[OBSERVER]["says"] |= operated
    if len(hosts.supervisors) > 1:  # its recorder does
        found[OBSERVER]["hears"] = set(keys)
    found["viewer"] = {"hears": set(keys), "asks": set(keys)}
    found["operator"] = {**found["viewer"], "says": operated}

    def on(host: str) -> set[str]:
        return {*hosts.may_run(host, layout.members), *hosts.routers_of(host)}

    far = {name: {what: set().union(*(found[one].get(what, ()) for one in (*on(host), *PEOPLE)))
                  for what in ("says", "hears", "answers", "asks")}
           for name, host in routers.items() if host != layout.plan.host}
    here = {name: right if name in PEOPLE or name in on(layout.plan.host) else {}
            for name, right in found.items() if name in layout.members or name in PEOPLE}
    return keys, here | far


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
