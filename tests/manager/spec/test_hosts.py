"""Systems of several hosts: what is refused, and what the link costs."""

from __future__ import annotations

import pytest

from rampart import SpecificationError, parse_specification
from rampart.actors.system.hosts import Hosts
from rampart.manager.spec.budget import check
from tests.documents.page import Page
from tests.two_hosts import two_hosts

ADDRESSES = {"robot": "192.168.7.1", "ground": "192.168.7.2"}
TEXT = two_hosts(ADDRESSES)
SPEC = parse_specification(TEXT, "two.toml")
WHEN_LOST = Page("how-to/several-machines").of("toml")[1]
TWO = '[[host]]\nname = "ground"\naddress = "192.168.7.2"\n\n'


def test_the_first_host_s_names_are_those_of_a_system_of_one_machine():
    hosts = Hosts(SPEC)
    assert hosts.supervisors == {"": "supervisor", "ground": "supervisor_ground"}
    assert hosts.guards_of("") == ("supervisor", "router_a", "router_b")
    assert hosts.home_of["hmi"] == "ground"
    assert hosts.home_of["DM1"] == ""
    assert hosts.dials(0, "tcp") == []
    assert hosts.listens(1, "tcp") == ["tcp/192.168.7.1:7461"]
    assert Hosts(SPEC, "ground").dials(1, "tls") == ["tls/192.168.7.1:7461"]
    assert hosts.meeting_place() == ("192.168.7.1", 7462)
    spec = parse_specification(TEXT.replace("192.168.7.1", "fd00::1"), "two.toml")
    assert Hosts(spec).listens(0, "tcp") == ["tcp/[fd00::1]:7460"]


def test_a_module_beyond_the_link_has_so_much_less_time():
    alone = {b.name: b for b in check(parse_specification(
        two_hosts(ADDRESSES, on_ground=("hmi", "teleoperation", "DM5")), "near.toml"))}
    far = {b.name: b for b in check(SPEC)}
    assert far["FTM10"].detection_s == pytest.approx(alone["FTM10"].detection_s + 0.3)
    assert far["FTM1"].detection_s == alone["FTM1"].detection_s


def test_the_mechanism_of_the_page_for_a_lost_link_fits_in_what_it_allows():
    text = TEXT.replace('"overload"]', '"overload", "link_lost"]').replace(
        "[[detection]]\n", f"{WHEN_LOST}\n[[detection]]\n", 1)
    lost, = (one for one in check(parse_specification(text, "lost.toml")) if one.name == "FTM15")
    assert (lost.time_left_s, lost.detection_s, lost.fits) == (10.0, 6.2, True)


@pytest.mark.parametrize(("old", "new", "message"), [
    (TWO, "", "$.host: one machine needs no [[host]]; remove it, or add another one"),
    ('address = "192.168.7.2"', 'address = "ground.local"',
     "host ground: address = 'ground.local': expected an IP address such as '192.168.7.1'"),
    ('address = "192.168.7.2"', 'address = "192.168.7.1"\nport = 7462',
     "host ground: port = 7462: each host uses 3 ports, and robot has the same address and uses "
     "those from 7460"),
    ('name = "ground"\naddress', 'name = "robot"\naddress', "$.host[1].name = 'robot': duplicate"),
    ('name = "safety_pilot"', 'name = "safety_pilot"\nhost = "ground"',
     "node safety_pilot: host = 'ground': expected 'robot', the first host"),
    ('name = "DM3"', 'name = "DM3"\nhost = "ground"\nprocess = "RM1"',
     "recovery RM1: host = 'robot': expected 'ground', the host of DM3, which shares the process"),
    ('name = "DM7"', 'name = "DM7"\nhost = "ground"',
     "detection DM7: parameters.timeout_s = 0.44: expected at least 0.58 s, two heartbeats and "
     "[link] delay_s: DM7 watches localization over the link"),
    ('name = "DM1"', 'name = "DM1"\nhost = "ground"',
     "$.timing: the time budget does not fit: FTM1"),
    ('name = "DM9"', 'name = "supervisor_ground"', "supervisor_ground': duplicate name, reserved"),
])
def test_refused(old, new, message):
    assert old in TEXT
    with pytest.raises(SpecificationError) as caught:
        parse_specification(TEXT.replace(old, new, 1), "two.toml")
    assert message in str(caught.value)


def test_without_hosts_no_node_can_be_on_one():
    one = '[[host]]\nname = "robot"\naddress = "192.168.7.1"\n\n'
    text = TEXT.replace(TWO, "").replace(one, "")
    with pytest.raises(SpecificationError, match=r"host = 'ground': unknown host; known: none"):
        parse_specification(text, "one.toml")
