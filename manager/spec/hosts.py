"""The machines of a system, and what is assumed of the network between them.

A system without a `[[host]]` runs on one machine. Of several the first is the robot's: it decides
who is to run what, gives the others their time, and takes over what a machine ran that cannot be
reached any more (`rampart.actors.hosts.placement`).
"""

from __future__ import annotations

from typing import Annotated

import msgspec

from rampart.manager.spec.tables import Name, Positive, Table

PORTS = 3
"""Of a host: its two routers, and where the robot's launcher is asked by the others'."""


MOST_CLOCK_S = 0.1
"""The most that the clocks of two hosts may differ: messages stamped further ahead are refused."""


class HostSpec(Table, frozen=True):
    """A machine.

    Attributes:
        name: By which nodes say that they run there.
        address: IP address of it, as the others reach it.
        port: The first of the three TCP ports that it uses.
    """

    name: Name
    address: str
    port: Annotated[int, msgspec.Meta(ge=1024, le=65_535 - PORTS)] = 7460


class Link(Table, frozen=True):
    """What is assumed of the network between hosts, and when it counts as lost; real seconds.

    Attributes:
        delay_s: Longest time that a message takes while the link is up, what is lost and sent
            again included.
        clock_s: How far the clocks of two hosts may be apart; one that is not known as well as
            that is told of. Every reader refuses what is stamped more than `MOST_CLOCK_S` ahead.
        lost_after_s: Nothing was heard of a host for so long: it is lost, and what it ran is
            started on the first host.
        return_after_s: A host has been heard for so long without a break: what was started in its
            place is its own again.
    """

    delay_s: Positive = 0.3
    clock_s: Annotated[float, msgspec.Meta(gt=0, le=MOST_CLOCK_S)] = MOST_CLOCK_S
    lost_after_s: Positive = 0.6
    return_after_s: Positive = 0.3
