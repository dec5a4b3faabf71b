"""Who may what, computed from classes; what follows for routers; and that both agree."""

from __future__ import annotations

import pytest

from rampart.actors.access.register import Register
from rampart.actors.access.rights import rights_of_all
from rampart.actors.access.rules import Host, rules_of
from rampart.actors.runtime.run_plan import RunPlan, load_system
from rampart.actors.system.layout import Layout
from tests.actors.access.declared import disagreements, on_each_host, rules_as_declared
from tests.actors.access.keyed import layout_of
from tests.two_hosts import two_hosts

LAYOUT = layout_of("osmosis")
RIGHTS = rights_of_all(LAYOUT)


def test_an_identity_that_is_not_in_the_register_has_no_rule():
    host = Host(nodes=frozenset(LAYOUT.members))
    register = Register().issued(["DM4", "DM5"], "node").revoked(["DM5"])
    assert set(rules_of(host, [host], RIGHTS, register)) == {"DM4"}
    again = register.issued(["DM5"], "node")
    assert set(rules_of(host, [host], RIGHTS, again)) == {"DM4", "DM5.2"}


def test_an_operator_with_the_name_of_a_node_is_no_node():
    host = Host(nodes=frozenset(LAYOUT.members))
    register = Register().issued(["safety_pilot"], "operator")
    said = {key for flow, messages, keys in rules_of(host, [host], RIGHTS, register)["safety_pilot"]
            if flow == "ingress" and "put" in messages for key in keys}
    assert "rampart/summit_xl/command" not in said
    assert "rampart/inject/order" in said


@pytest.mark.parametrize(("system", "who"), [
    ("osmosis", {"summit_xl/command": "safety_pilot", "recovery/RM1/command": "ftm_manager",
                 "supervisor/event": "supervisor", "detection/DM4": "DM4",
                 "heartbeat/DM5": "DM5", "inject/order": "operator observer hmi",
                 "manager/adapt": "operator observer hmi", "world/truth": "simulator"}),
    ("tests/systems/cell.toml", {"manager/decision": "cell_manager"})])
def test_the_rules_match_the_declarations(system, who):
    layout = layout_of(system)
    wrong, speakers = disagreements(layout, rules_as_declared(layout))
    assert wrong == []
    assert sum(map(len, speakers.values())) > 30
    assert {key: speakers[key] for key in who} == {key: set(who[key].split()) for key in who}


def test_of_two_hosts_each_lets_through_what_may_run_on_the_other_and_no_more(tmp_path):
    file = tmp_path / "two.toml"
    file.write_text(two_hosts(
        {"robot": "192.168.7.1", "ground": "192.168.7.2"}, system="paper"), encoding="utf-8")
    plan = RunPlan(system_file=str(file))
    who: dict[str, set[str]] = {}
    for layout in on_each_host(Layout(plan, load_system(plan))):
        wrong, speakers = disagreements(layout, rules_as_declared(layout))
        assert wrong == []
        for key, names in speakers.items():
            who.setdefault(key, set()).update(names)
    assert who["control/command"] == {"osmosis_control", "router_a", "router_b"}
    assert who["detection/DM5"] == {
        "DM5", "router_a_ground", "router_b_ground", "router_a", "router_b"}
    assert who["supervisor/supervisor_ground/nodes"] == {
        "router_a_ground", "router_b_ground", "supervisor_ground"}
