"""Systems on two machines: the robot's, and a ground station with a page and some modules."""

from collections.abc import Collection, Mapping

from tests import system_file

ON_GROUND = ("hmi", "teleoperation", "DM5", "DM10", "DM11", "DM13")

_PATIENT = """event = "non_control_node_crash"
against = { within_s = 5.0, hazard = "the operator has neither page nor stick" }"""


def several_hosts(addresses: Mapping[str, str], places: Mapping[str, Collection[str]],
                  system: str = "osmosis", delay_s: float = 0.3) -> str:
    """Return the specification of a system on several hosts.

    Args:
        addresses: Of the hosts, the robot's first.
        places: By host, names of what runs there and not on the robot's.
        system: Which.
        delay_s: Of a message between them, at most.
    """
    text = system_file(system).read_text(encoding="utf-8")
    hosts = "".join(f'[[host]]\nname = "{name}"\naddress = "{address}"\n\n'
                    for name, address in addresses.items())
    for place, names in places.items():
        for name in names:
            text = text.replace(f'\nname = "{name}"\n', f'\nname = "{name}"\nhost = "{place}"\n', 1)
    text = text.replace('event = "non_control_node_crash"\nagainst = "parent"', _PATIENT, 1)
    link = f"[link]\ndelay_s = {delay_s}\n\n"
    return text.replace("[[node]]\n", f"{link}{hosts}[[node]]\n", 1)


def two_hosts(addresses: Mapping[str, str], on_ground: Collection[str] = ON_GROUND,
              system: str = "osmosis", delay_s: float = 0.3) -> str:
    """Return the specification of a system, some of it on the second of two hosts."""
    _, second = addresses
    return several_hosts(addresses, {second: on_ground}, system, delay_s)
