"""The hosts of a system: their nodes, and the names of their supervisors and routers.

Here the name of the first host, usually the only one, is "".
"""

from __future__ import annotations

import math
from collections.abc import Iterable

from rampart.actors.bus.run_folder import ROUTERS
from rampart.actors.runtime.run_plan import OBSERVER, SUPERVISOR, on_host
from rampart.manager.spec.hosts import HostSpec
from rampart.manager.spec.schema import SystemSpec


class Hosts:
    """The hosts of a system, as one of them sees it.

    Args:
        spec: The system.
        own: Name of this host.

    Attributes:
        several: Whether there is more than one host.
        supervisors: Name of the supervisor by host.
        called: The same by the name in the specification, the first host's too; empty for a single
            host.
        link: Assumptions about the network between the hosts.
        command_age_s: Commands older than this are refused.
        home_of: Host of each node, on which it runs unless that host is lost.

    Raises:
        ValueError: The host does not exist.
    """

    def __init__(self, spec: SystemSpec, own: str = "") -> None:
        first = spec.hosts[0].name if spec.hosts else ""
        names = tuple("" if host.name == first else host.name for host in spec.hosts) or ("",)
        if own not in names:
            raise ValueError(f"no host {own!r}")
        self.several = len(names) > 1
        self.supervisors = {name: on_host(SUPERVISOR, name) for name in names}
        self.called = {host.name: self.supervisors[name] for name, host in zip(
            names, spec.hosts, strict=False) if self.several}
        self.home_of = {node: "" if host == first else host
                        for node, host in spec.host_of.items()}
        self.link = spec.link
        self.command_age_s = (
            2 * spec.link.delay_s + spec.link.clock_s if self.several else math.inf)
        self._specs: dict[str, HostSpec] = dict(zip(names, spec.hosts, strict=False))
        self._own = own

    def guards_of(self, host: str) -> tuple[str, ...]:
        """Return the supervisor and routers of a host, whose heartbeats show that it works."""
        return (self.supervisors[host], *self.routers_of(host))

    def routers_of(self, host: str) -> tuple[str, ...]:
        """Return the names of a host's routers."""
        return tuple(on_host(name, host) for name in ROUTERS)

    def may_run(self, host: str, members: Iterable[str]) -> frozenset[str]:
        """Return the actors that a host may run, including its guards.

        The first host may run the actors of all others.
        """
        guards = {on_host(name, other): other for other in self.supervisors
                  for name in (SUPERVISOR, OBSERVER)}
        return frozenset(name for name in members if (
            guards[name] == host if name in guards else host in {"", self.home_of[name]}))

    def address_of(self, host: str) -> str:
        """Return the address of a host; "" if there is only one."""
        return self._specs[host].address if self.several else ""

    def heard_by(self, host: str, nodes: Iterable[str]) -> tuple[str, ...]:
        """Return the nodes whose heartbeats the supervisor of a host receives.

        These are its own routers and nodes, on the first host all nodes, because it may have to run
        them, and the guards of the other hosts.
        """
        return (*(name for name in self.guards_of(host) if name != self.supervisors[host]),
                *(node for node in nodes if host in {"", self.home_of[node]}),
                *(name for other in self.supervisors if other != host
                  for name in self.guards_of(other)))

    def listens(self, place: int, protocol: str) -> list[str]:
        """Return where a router of this host listens for those of the others.

        Args:
            place: Number of the router, 0 or 1.
            protocol: "tcp" or "tls".
        """
        return [_endpoint(self._specs[self._own], place, protocol)] if self.several else []

    def dials(self, place: int, protocol: str) -> list[str]:
        """Return the routers that a router of this host dials: one on each host before it.

        Each router dials the one of its own number. If every router were linked to both of another
        host, Zenoh (1.10) would no longer pass messages between the two routers of one host after
        the other host is lost.
        """
        before = list(self._specs)[:list(self._specs).index(self._own)] if self.several else []
        return [_endpoint(self._specs[host], place, protocol) for host in before]

    def meeting_place(self) -> tuple[str, int]:
        """Return address and port of the first host's launcher."""
        first = self._specs[""]
        return first.address, first.port + len(ROUTERS)


def _endpoint(host: HostSpec, place: int, protocol: str) -> str:
    address = f"[{host.address}]" if ":" in host.address else host.address
    return f"{protocol}/{address}:{host.port + place}"
