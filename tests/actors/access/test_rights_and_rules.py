"""Who may what, computed from classes, and what follows for routers."""

import pytest

from rampart.actors.access.register import Register
from rampart.actors.access.rights import OPERATOR, VIEWER, Rights, rights_of_all
from rampart.actors.access.rules import Host, hosts_of, rules_of
from rampart.actors.bus.topic import Qos
from rampart.actors.runtime.actor import BASE_INPUTS
from rampart.actors.runtime.run_plan import RunPlan, load_system
from rampart.actors.system.layout import Layout
from rampart.actors.system.members import Member
from rampart.actors.system.topics import system_topics
from tests.actors.access.keyed import covered, every_key, layout_of
from tests.two_hosts import two_hosts

LAYOUT = layout_of("osmosis")
RIGHTS = rights_of_all(LAYOUT)
FORBIDDEN = ("nothing/declared", "**", "*/*", "heartbeat/*", "alive/DM5/1")
"""What nobody declares; as keys, expressions with wildcards included."""


def said_by(granted) -> set[str]:
    """Return what a router lets in from an identity."""
    return {key.removeprefix("rampart/") for flow, messages, keys in granted
            if flow == "ingress" and "put" in messages for key in keys}


def test_an_identity_that_is_not_in_the_register_has_no_rule_and_a_person_no_node_s():
    host = Host(nodes=frozenset(LAYOUT.members))
    register = Register().issued(["DM4", "DM5"], "node").revoked(["DM5"])
    assert set(rules_of(host, [host], RIGHTS, register)) == {"DM4"}
    again = register.issued(["DM5"], "node").issued(["safety_pilot"], OPERATOR)
    rules = rules_of(host, [host], RIGHTS, again)
    assert set(rules) == {"DM4", "DM5.2", "safety_pilot"}
    assert "inject/order" in said_by(rules["safety_pilot"])
    assert "summit_xl/command" not in said_by(rules["safety_pilot"])
    own, passed = RIGHTS["DM4"], {(flow, message): keys for flow, messages, keys in rules["DM4"]
                                  for message in messages}
    assert passed.items() >= {
        ("ingress", "put"): own.publishes, ("ingress", "declare_subscriber"): own.subscribes,
        ("ingress", "query"): own.queries, ("ingress", "declare_queryable"): own.answers,
        ("ingress", "reply"): own.answers, ("egress", "put"): own.subscribes,
        ("egress", "reply"): own.queries}.items()
    assert {message for _, message in passed} == {
        "put", "declare_subscriber", "query", "declare_queryable", "reply"}


def is_heard(member: Member, key: str) -> bool:
    """Return whether a class declares that it hears a key."""
    for topic in (*member.actor.inputs(), *BASE_INPUTS):
        one = topic.member(key)
        if one is not None and (not one or (names := member.actor.names(
                topic, member.name, member.parameters)) is None or one in names):
            return True
    return False


@pytest.mark.parametrize("system", ["osmosis", "tests/systems/cell.toml"])
def test_each_identity_has_the_rights_that_its_class_declares_and_no_others(system):
    layout = layout_of(system)
    rights = rights_of_all(layout)
    topics = {*system_topics(layout.spec), *BASE_INPUTS}
    commands = {key for key in every_key(layout) if any(
        topic.qos is Qos.COMMAND and topic.member(key) is not None for topic in topics)}
    keys = {*every_key(layout), *FORBIDDEN}
    assert {"inject/order", "manager/reset"} < commands
    for name, member in layout.members.items():
        if name != "observer":
            says = {key for key in keys if key in member.publishes or member.actor.published(
                key, name, member.parameters) is not None}
            hears = {key for key in keys if key in member.hears or is_heard(member, key)}
            own = rights[name]
            assert [covered(keys, one) for one in (
                own.publishes, own.subscribes, own.answers, own.queries)] == [
                says, hears, says - commands, hears - commands], name


def test_only_some_may_say_what_others_obey():
    def who(key):
        return {name for name, right in RIGHTS.items() if covered([key], right.publishes)}

    everybody = {"operator", "observer", "hmi"}
    for key, names in {
            "summit_xl/command": {"safety_pilot"}, "recovery/RM1/command": {"ftm_manager"},
            "supervisor/event": {"supervisor"}, "detection/DM4": {"DM4"},
            "heartbeat/DM5": {"DM5"}, "heartbeat/hmi": {"hmi"}, "diagnostic/hmi": {"hmi"},
            "inject/order": everybody, "manager/adapt": everybody,
            "world/truth": {"simulator"}}.items():
        assert who(key) == names
    everything = frozenset({"rampart/**"})
    assert RIGHTS[VIEWER] == Rights(subscribes=everything, queries=everything)


def test_of_two_hosts_each_lets_through_what_may_run_on_the_other_and_no_more(tmp_path):
    file = tmp_path / "two.toml"
    file.write_text(two_hosts(
        {"robot": "192.168.7.1", "ground": "192.168.7.2"}, system="paper"), encoding="utf-8")
    plan = RunPlan(system_file=str(file))
    layout = Layout(plan, load_system(plan))
    hosts, rights = hosts_of(layout), rights_of_all(layout)
    register = Register().issued([OPERATOR], OPERATOR)
    for host in hosts.values():
        register = register.issued(host.routers, "router").issued(sorted(host.nodes), "node")
    who: dict[str, set[str]] = {}
    for host in hosts.values():
        rules = rules_of(host, list(hosts.values()), rights, register)
        for name in rules.keys() - set(host.routers):
            for key in said_by(rules[name]):
                who.setdefault(key, set()).add(name)
    assert who["control/command"] == {"osmosis_control", "router_a", "router_b"}
    assert who["detection/DM5"] == {
        "DM5", "router_a_ground", "router_b_ground", "router_a", "router_b"}
    assert who["supervisor/supervisor_ground/nodes"] == {
        "router_a_ground", "router_b_ground", "supervisor_ground"}
    assert who["summit_xl/command"] == {"safety_pilot", "router_a", "router_b"}
