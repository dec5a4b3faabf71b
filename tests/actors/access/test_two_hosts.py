"""The link between the routers of two hosts, over real TLS: what nodes there declare, no more."""

from __future__ import annotations

import pytest

from rampart.actors.access import key_folder
from rampart.actors.access.register import read_register
from rampart.actors.access.rights import rights_of_all
from rampart.actors.access.rules import Host, config_of, rules_of
from rampart.actors.bus.zenoh_session import Credentials, credentials_in, session_config
from rampart.actors.supervision.root import reserve_ports
from tests.actors.access.keyed import layout_of, make_keys, opened, wait_for

pytestmark = [pytest.mark.processes, pytest.mark.alone]

LAYOUT = layout_of("osmosis")
GROUND = frozenset({"hmi", "teleoperation", "DM5"})
HOSTS = [Host("", nodes=frozenset(LAYOUT.members) - GROUND),
         Host("ground", ("router_a_ground",), GROUND)]


class Hosts:
    """A router on each of two hosts, linked, and clients of either."""

    def __init__(self, keys):
        self.keys = keys
        self.kept = reserve_ports(9_100)
        self.at = {name: f"tls/127.0.0.1:{kept.getsockname()[1]}"
                   for name, kept in zip(("router_a", "router_a_ground"), self.kept, strict=True)}

    def shown(self, name):
        found = credentials_in(str(self.keys), name)
        return Credentials(found.authority, found.own)

    def router(self, host, dial=()):
        rights = rights_of_all(LAYOUT)
        rights["router_a_ground"] = rights["router_a"]
        name = host.routers[0]
        rules = rules_of(host, HOSTS, rights, read_register(self.keys))
        return opened(session_config(
            [self.at[name]], [self.at[one] for one in dial], self.shown(name), config_of(rules)))

    def client(self, name):
        at = self.at["router_a_ground" if name in GROUND else "router_a"]
        return opened(session_config((), [at], self.shown(name)))


@pytest.fixture
def hosts(tmp_path):
    keys = make_keys(tmp_path / "keys", LAYOUT)
    key_folder.issue(keys, ["router_a_ground"], "router")
    made = Hosts(keys)
    yield made
    for one in made.kept:
        one.close()


def test_a_host_that_is_taken_over_says_nothing_that_is_not_its_nodes(hosts):
    """Its router, with its key, tries every way; the robot's router lets nothing through."""
    forged = ("summit_xl/command", "supervisor/nodes", "supervisor/event",
              "recovery/RM1/command", "detection/DM4", "inject/order", "**")
    with hosts.router(HOSTS[0]), hosts.client("router_a") as everybody:
        got: list[str] = []
        held = everybody.declare_subscriber("rampart/**", lambda s: got.append(str(s.key_expr)))
        taken = session_config([hosts.at["router_a_ground"]], [hosts.at["router_a"]],
                               hosts.shown("router_a_ground"))
        with opened(taken) as ground:
            def arrived():
                for key in forged:
                    ground.put(f"rampart/{key}", "forged")
                ground.put("rampart/detection/DM5", "own")
                return "rampart/detection/DM5" in got

            assert wait_for(arrived)
            arrived()
            answers = [r for r in everybody.get("rampart/summit_xl/command", timeout=0.5)
                       if r.ok is not None]
        # inject/order is the page's to say, and the page is there
        assert set(got) == {"rampart/detection/DM5", "rampart/inject/order"}
        assert answers == []
        held.undeclare()
