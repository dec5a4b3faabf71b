"""Do the access rules say what the classes declare? Checked pair by pair, for `rampart verify`.

The rules are read as a router reads them: from Zenoh's configuration, by the name in a certificate,
a key let through if a rule's expression includes it. What is declared is asked of each class, key
by key. So neither the way from classes to rules nor Zenoh's library is used, and a mistake there
shows as a pair of an identity and a key on which the two disagree.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

import msgspec

from rampart.actors.bus.topic import ROOT, Members, Qos, Topic
from rampart.actors.bus.topics import INJECT
from rampart.actors.runtime.actor import BASE_INPUTS, BASE_OUTPUTS
from rampart.actors.runtime.run_plan import OBSERVER
from rampart.actors.system.layout import Layout, router
from rampart.actors.system.members import Member, shows_panels
from rampart.actors.system.topics import declared_topics

PEOPLE = ("operator", "viewer")
MOST_SHOWN = 20

_INCARNATION = "1"
_FOREIGN = ("nothing/declared", "**", "*/*", "heartbeat/*", "alive/*/*", "gone/*")
"""What nobody declares; as keys, expressions with wildcards included."""

Claim = tuple[str, str, str]
"""Flow, message, and whether that is to say, to hear, to answer, to ask, or to be there."""

_CLAIMS: tuple[Claim, ...] = (
    ("ingress", "put", "says"), ("ingress", "declare_subscriber", "hears"),
    ("egress", "put", "hears"), ("ingress", "declare_queryable", "answers"),
    ("ingress", "reply", "answers"), ("ingress", "query", "asks"), ("egress", "reply", "asks"),
    ("ingress", "liveliness_token", "is there"), ("ingress", "delete", "never"),
    ("egress", "delete", "never"))
_WHAT = tuple(dict.fromkeys(what for _, _, what in _CLAIMS))


class AccessReport(msgspec.Struct, frozen=True):
    """What came of the check.

    Attributes:
        identities: that were looked at: all but the host's own routers, which hand everything on.
        keys: on which.
        pairs: of an identity and a key, each looked at for all that Zenoh can refuse.
        let_through: pairs in which the identity may publish.
        wrong: how many things are let through that nobody declares, or declared and refused.
        examples: the first of them, in words.
        speakers: by key, who may publish on it.
    """

    identities: int
    keys: int
    pairs: int
    let_through: int
    wrong: int
    examples: tuple[str, ...]
    speakers: dict[str, tuple[str, ...]]

    @property
    def holds(self) -> bool:
        """Whether the rules say what is declared."""
        return self.wrong == 0


def check_access(layout: Layout, config: Mapping[str, Any]) -> AccessReport:
    """Compare what a router lets through with what is declared.

    Args:
        layout: of the system, as the host of the router has it.
        config: Zenoh's `access_control`; the names in certificates are those of the identities,
            `operator` and `viewer` those of people.
    """
    declared = _Declared(layout)
    keys = list(declared.keys())
    wrong: list[str] = []
    speakers: dict[str, list[str]] = {}
    identities = declared.identities
    for name in identities:
        claims = [(claim, _let_through(config, name, *claim[:2])) for claim in _CLAIMS]
        for key in keys:
            said = {what: declared.may(name, what, key) for what in _WHAT}
            for (flow, message, what), lets in claims:
                may, should = lets(f"/{ROOT}/{key}"), said[what]
                if may and message == "put" and flow == "ingress":
                    speakers.setdefault(key, []).append(name)
                if may != should:
                    wrong.append(f"{name}: {message} of {key!r} ({flow}) is " + (
                        "let through, and not declared" if may else "declared, and refused"))
    return AccessReport(
        len(identities), len(keys), len(identities) * len(keys),
        sum(map(len, speakers.values())), len(wrong), tuple(wrong[:MOST_SHOWN]),
        {key: tuple(those) for key, those in sorted(speakers.items())})


def check_each_host(layout: Layout, rules: Callable[[Layout], Mapping[str, Any]]) -> AccessReport:
    """Compare what the routers of each host let through with what is declared; all in one report.

    Args:
        layout: of the system.
        rules: returns the rules of the routers of the host that a layout is of.
    """
    found: dict[str, AccessReport] = {}
    for host in layout.hosts.supervisors:
        there = Layout(msgspec.structs.replace(layout.plan, host=host), layout.spec)
        found[host] = check_access(there, rules(there))
    reports = list(found.values())
    if len(reports) == 1:
        return reports[0]
    speakers: dict[str, dict[str, None]] = {}
    for report in reports:
        for key, those in report.speakers.items():
            speakers.setdefault(key, {}).update(dict.fromkeys(those))
    return AccessReport(
        reports[0].identities, reports[0].keys, sum(one.pairs for one in reports),
        sum(one.let_through for one in reports), sum(one.wrong for one in reports),
        tuple(f"host {host or 'the first'}: {line}" for host, report in found.items()
              for line in report.examples)[:MOST_SHOWN],
        {key: tuple(those) for key, those in sorted(speakers.items())})


def includes(expression: str, key: str) -> bool:
    """Whether a key expression includes another, as Zenoh has it; without `$*`."""
    return _pattern([expression]).fullmatch(f"/{key}") is not None


def _pattern(expressions: Iterable[str]) -> re.Pattern[str]:
    """Return what matches the keys that one of some expressions includes, with a slash before each.

    `*` stands for one chunk, also for another `*`, and `**` for any number of chunks, none too.
    """
    patterns = []
    for expression in expressions:
        text = ""
        for chunk in expression.split("/"):
            if chunk == "**":
                text += "(?:/[^/]+)*"
            else:
                text += r"/(?!\*\*(?:/|\Z))[^/]+" if chunk == "*" else "/" + re.escape(chunk)
        patterns.append(text)
    return re.compile("|".join(f"(?:{one})" for one in patterns) or r"(?!)")


def _let_through(config: Mapping[str, Any], common_name: str, flow: str,
                 message: str) -> Callable[[str], bool]:
    """Return whether a router lets a message through on a key, by the name in a certificate.

    What is returned takes the key with a slash before it.
    """
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
    allowed, denied = _pattern(found["allow"]), _pattern(found["deny"])
    by_default = config["default_permission"] == "allow"
    return lambda key: denied.fullmatch(key) is None and (
        by_default or allowed.fullmatch(key) is not None)


class _Declared:
    """What the classes of a system declare, asked key by key."""

    def __init__(self, layout: Layout) -> None:
        hosts = layout.hosts
        self._own = layout.plan.host
        routers = {name: host for host in hosts.supervisors for name in hosts.routers_of(host)}
        self._members = {**layout.members, **{name: router(name) for name in routers}}
        self._may_run = {host: {*hosts.may_run(host, layout.members), *hosts.routers_of(host)}
                         for host in hosts.supervisors}
        self._hosts_of_supervisors = {name: host for host, name in hosts.supervisors.items()}
        self._far = {name: host for name, host in routers.items() if host != self._own}
        self.identities = (*layout.members, *self._far, *PEOPLE)
        self._pages = [m for m in layout.members.values() if shows_panels(m.actor)]
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
        for name in self._names:
            yield f"alive/{name}/{_INCARNATION}"
            yield f"gone/{name}"
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
        if what == "is there":
            return key == f"alive/{identity}/{_INCARNATION}"
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
        if node := _gone(key):
            return node in self._may_run.get(self._hosts_of_supervisors.get(identity, "?"), ())
        return (key in member.actor.own_keys(member.parameters) or _says(member, key)
                or (identity == OBSERVER and self._is_operated(key)))

    def _hears(self, identity: str, key: str) -> bool:
        if identity in PEOPLE:
            return True
        member = self._members[identity]
        if node := _gone(key):
            return node in member.actor.watches(identity, member.parameters)
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


def _gone(key: str) -> str:
    """Return the node of whose end a key tells, "" if it is no such key."""
    place, _, node = key.partition("/")
    return node if place == "gone" else ""


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
