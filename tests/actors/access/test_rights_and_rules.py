"""Who may what, computed from classes; what follows for routers; and that both agree."""

from __future__ import annotations

import copy

import pytest
import zenoh

from rampart.actors.access.register import Register
from rampart.actors.access.rights import rights_of_all
from rampart.actors.access.rules import Host, rules_of
from rampart.actors.bus.zenoh_session import session_config
from rampart.actors.runtime.run_plan import RunPlan, load_system
from rampart.actors.system.layout import Layout
from rampart.sim.virtual.virtual_bus import VirtualBus
from rampart.testing import virtual_run
from tests import two_hosts as systems
from tests.actors.access.declared import disagreements, on_each_host, rules_as_declared
from tests.actors.access.keyed import layout_of

LAYOUT = layout_of("osmosis")
RIGHTS = rights_of_all(LAYOUT)


def who_says(key):
    return {name for name, rights in RIGHTS.items()
            if any(zenoh.KeyExpr(one).includes(f"rampart/{key}") for one in rights.says)}


@pytest.mark.parametrize(("key", "who"), [
    ("summit_xl/command", {"safety_pilot"}),
    ("recovery/RM1/command", {"ftm_manager"}),
    ("manager/decision", {"ftm_manager"}),
    ("supervisor/nodes", {"supervisor"}),
    ("supervisor/event", {"supervisor"}),
    ("detection/DM4", {"DM4"}),
    ("heartbeat/DM4", {"DM4"}),
    ("heartbeat/router_a", {"router_a"}),
    ("inject/order", {"operator", "observer", "hmi"}),
    ("manager/adapt", {"operator", "observer", "hmi"}),
    ("manager/reset", {"operator", "observer", "hmi"}),
    ("world/truth", {"simulator"}),
    ("nothing/declared", set()),
])
def test_a_key_is_its_publishers(key, who):
    assert who_says(key) == who


def test_a_viewer_only_looks():
    assert not RIGHTS["viewer"].says
    assert not RIGHTS["viewer"].answers


@pytest.mark.slow
def test_what_actors_do_in_a_mission_with_faults_they_may(monkeypatch):
    """Or it would be refused when keys are on; what they may is no more than what they do."""
    done = {"says": set(), "hears": set(), "asks": set()}
    for what, method in (("says", "publish"), ("hears", "subscribe"), ("asks", "latest")):
        before = getattr(VirtualBus, method)

        def noted(bus, *words, what=what, before=before):
            key = words[0] if what == "asks" else words[1]
            done[what].add((bus.node, key))
            return before(bus, *words)

        monkeypatch.setattr(VirtualBus, method, noted)
    found = virtual_run("osmosis", "kill:osmosis_control@5", "command-out-of-bounds@20",
                        "wedge:localization@30", options={"mission": "A"})
    assert found.record.safety == "safe"
    for what, those in done.items():
        assert len(those) > 80
        for node, key in those:
            rights = RIGHTS["observer" if node == "injector" else node]
            if key != "rampart/heartbeat/injector":  # which nobody hears
                assert any(zenoh.KeyExpr(one).includes(key) for one in getattr(rights, what)), (
                    node, what, key)


def keys_matched(rules, name, flow, message):
    return {key for one in rules.get(name, ()) if one[0] == flow and message in one[1]
            for key in one[2]}


def two_hosts():
    ground = frozenset({"hmi", "teleoperation", "DM5"})
    hosts = [Host("", nodes=frozenset(LAYOUT.members) - ground),
             Host("ground", ("router_a_ground", "router_b_ground"), ground)]
    rights = {**RIGHTS, **dict.fromkeys(hosts[1].routers, RIGHTS["router_a"])}
    register = Register().issued(
        [*hosts[0].routers, *hosts[1].routers], "router").issued(
        LAYOUT.members, "node").issued(["ada"], "operator")
    return hosts, rights, register


def test_another_host_says_what_its_nodes_say_and_no_more():
    hosts, rights, register = two_hosts()
    rules = rules_of(hosts[0], hosts, rights, register)
    for name in hosts[1].routers:
        said = keys_matched(rules, name, "ingress", "put")
        assert {"rampart/detection/DM5", "rampart/teleoperation/command"} <= said
        assert not [key for key in ("rampart/summit_xl/command", "rampart/supervisor/nodes",
                                    "rampart/detection/DM4",
                                    "rampart/recovery/RM1/command")
                    if any(zenoh.KeyExpr(one).includes(key) for one in said)]
        assert keys_matched(rules, name, "ingress", "liveliness_token") == set()
    assert "DM5" not in rules  # it is no client here
    assert "DM4" in rules
    assert keys_matched(rules, "router_a", "ingress", "put") == {"rampart/**"}


def test_who_hears_on_one_host_is_known_to_who_says_it_on_the_other():
    hosts, rights, register = two_hosts()
    rules = rules_of(hosts[0], hosts, rights, register)
    told = keys_matched(rules, "router_a_ground", "egress", "declare_subscriber")
    assert "rampart/detection/*" in told  # the manager's, for DM5 there
    assert "rampart/summit_xl/command" not in told


def test_where_people_look_they_hear_everything():
    hosts, rights, register = two_hosts()
    rules = rules_of(hosts[0], hosts, rights, register)
    assert "rampart/**" in keys_matched(rules, "router_a_ground", "egress", "put")
    assert "rampart/inject/order" in keys_matched(rules, "router_a_ground", "ingress", "put")
    assert "rampart/summit_xl/command" not in keys_matched(
        rules, "router_a_ground", "ingress", "put")


def test_who_is_not_in_the_register_is_in_no_rule():
    host = Host(nodes=frozenset(LAYOUT.members))
    register = Register().issued(["DM4", "DM5"], "node").revoked(["DM5"])
    assert set(rules_of(host, [host], RIGHTS, register)) == {"DM4"}
    again = register.issued(["DM5"], "node")
    assert set(rules_of(host, [host], RIGHTS, again)) == {"DM4", "DM5.2"}


def test_an_operator_with_the_name_of_a_node_is_no_node():
    host = Host(nodes=frozenset(LAYOUT.members))
    register = Register().issued(["safety_pilot"], "operator")
    said = keys_matched(rules_of(host, [host], RIGHTS, register), "safety_pilot", "ingress", "put")
    assert "rampart/summit_xl/command" not in said
    assert "rampart/inject/order" in said


def test_zenoh_takes_the_rules():
    config = session_config(["unixsock-stream//nowhere"], [], None, rules_as_declared(LAYOUT))
    assert '"default_permission":"deny"' in config.get_json("access_control")


# -- rules and declarations agree ---------------------------------------------------------------


@pytest.mark.parametrize("system", ["osmosis", "paper", "tests/systems/cell.toml"])
def test_the_rules_say_what_is_declared(system):
    layout = layout_of(system)
    wrong, speakers = disagreements(layout, rules_as_declared(layout))
    assert wrong == []
    assert sum(map(len, speakers.values())) > 30
    assert speakers.get("summit_xl/command", {"safety_pilot"}) == {"safety_pilot"}


def with_rule(config, name, **fields):
    rule = {"id": "tampered", "permission": "allow", "flows": ["ingress"], "messages": ["put"],
            "key_exprs": ["rampart/summit_xl/command"], **fields}
    config["rules"].append(rule)
    config["policies"].append({"rules": ["tampered"], "subjects": [name]})


TAMPERED = {
    "a key more": lambda c: with_rule(c, "DM4"),
    "a wildcard": lambda c: with_rule(c, "DM4", key_exprs=["rampart/**"]),
    "another's token": lambda c: with_rule(
        c, "DM4", messages=["liveliness_token"], key_exprs=["rampart/alive/DM5/1"]),
    "another's answer": lambda c: with_rule(
        c, "DM4", messages=["declare_queryable", "reply"], key_exprs=["rampart/plan/route"]),
    "deleting": lambda c: with_rule(c, "DM4", messages=["delete"]),
    "hearing": lambda c: with_rule(c, "DM4", messages=["declare_subscriber"]),
    "being told": lambda c: with_rule(c, "viewer", key_exprs=["rampart/inject/order"]),
    "a refusal": lambda c: with_rule(c, "safety_pilot", permission="deny"),
    "the other's name": lambda c: c["subjects"][3].update(cert_common_names=["DM1", "DM2"]),
    "any name": lambda c: c["subjects"][3].pop("cert_common_names"),
    "everything": lambda c: c.update(default_permission="allow"),
    "not in force": lambda c: c.update(enabled=False),
    "one rule less": lambda c: c["rules"].pop(0),
    "one policy less": lambda c: c["policies"].pop(),
}


@pytest.mark.parametrize("how", TAMPERED)
def test_a_change_of_the_rules_is_found(how):
    layout = layout_of("paper")
    config = rules_as_declared(layout)
    TAMPERED[how](config)
    assert disagreements(layout, config)[0]


def two_hosts_layout(tmp_path):
    file = tmp_path / "two.toml"
    text = systems.two_hosts({"robot": "192.168.7.1", "ground": "192.168.7.2"})
    file.write_text(text, encoding="utf-8")
    plan = RunPlan(system_file=str(file))
    return Layout(plan, load_system(plan))


def test_of_two_hosts_each_lets_through_what_may_run_on_the_other_and_no_more(tmp_path):
    who: dict[str, set[str]] = {}
    for layout in on_each_host(two_hosts_layout(tmp_path)):
        wrong, speakers = disagreements(layout, rules_as_declared(layout))
        assert wrong == []
        for key, names in speakers.items():
            who.setdefault(key, set()).update(names)
    assert who["control/command"] == {"osmosis_control", "router_a", "router_b"}
    assert who["detection/DM10"] == {
        "DM10", "router_a_ground", "router_b_ground", "router_a", "router_b"}
    assert who["supervisor/supervisor_ground/nodes"] == {
        "router_a_ground", "router_b_ground", "supervisor_ground"}


def test_rules_by_which_the_other_host_may_command_the_wheels_are_found(tmp_path):
    layout = next(on_each_host(two_hosts_layout(tmp_path)))
    config = copy.deepcopy(rules_as_declared(layout))
    for rule in config["rules"]:
        if rule["id"].startswith("router_a_ground ") and "put" in rule["messages"]:
            rule["key_exprs"].append("rampart/summit_xl/command")
    assert disagreements(layout, config)[0][0] == (
        "router_a_ground: put of 'summit_xl/command' (ingress) is let through, and not declared")
