"""The tables `[[host]]` and `[link]`: machines of a system, and the network between them.

A system without a `[[host]]` runs on one machine. Of several hosts the first is on the robot. It
decides what each host runs, gives the others their time, and takes over the nodes of a lost host
(`rampart.actors.hosts.placement`).
"""

from __future__ import annotations

from typing import Annotated

import msgspec

from rampart.manager.spec.tables import Name, Positive, Table

PORTS = 3
"""Of a host: two for its routers, one on which the first host's launcher answers the others."""

MOST_CLOCK_S = 0.1
"""Largest difference of two hosts' clocks: readers refuse messages stamped further ahead."""


class HostSpec(Table, frozen=True):
    """A machine.

    Attributes:
        name: Name, which nodes give in `host`.
        address: IP address by which the other hosts reach it.
        port: First of the three TCP ports that it uses.
    """

    name: Name
    address: str
    port: Annotated[int, msgspec.Meta(ge=1024, le=65_535 - PORTS)] = 7460


class Link(Table, frozen=True):
    """Assumptions about the network between hosts; real seconds.

    Attributes:
        delay_s: Longest delay of a message while the link is up, retransmissions included.
        clock_s: Largest difference of two hosts' clocks; a larger uncertainty is reported.
        lost_after_s: A host that is silent for this long is lost. The first host starts its nodes.
        return_after_s: A lost host that is received for this long without a break gets its nodes
            back.
    """

    delay_s: Positive = 0.3
    clock_s: Annotated[float, msgspec.Meta(gt=0, le=MOST_CLOCK_S)] = MOST_CLOCK_S
    lost_after_s: Positive = 0.6
    return_after_s: Positive = 0.3
