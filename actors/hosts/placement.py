"""Placement of units on several hosts: what one supervisor runs. Pure.

Each unit has a home. While a host is lost, because its supervisor and its routers are silent, the
first host (the robot's) runs the units of that home. When the host has been back for a while, the
first host ends them, and the home starts them again. Two rules replace an agreement:

* **The highest incarnation counts.** What the first host starts in another one's place has an
  incarnation that the home cannot have reached (`next_epoch`). A supervisor that receives a higher
  incarnation than its own ends its process, and all readers on its host refuse lower ones.
* **Only the first host takes over.** A home that does not receive the first host continues its own
  processes. Only hosts on its side of the partition receive them.

So a recovery module obeys one manager at any time: the highest incarnation that it receives.

A link may carry messages one way only, and may fail again at any time. So nothing is given back to
a home that still reports its own process. And the first host repeats the incarnation that it has
given back until the home runs a higher one (`given_back`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

from rampart.actors.bus.run_folder import next_epoch
from rampart.actors.ftm.messages import NodeInfo
from rampart.manager.spec.hosts import Link

FIRST = ""
"""Name of the first host."""

_GRACE_S = 10.0
"""A host may start for so long before its silence counts."""

_TABLE_S = 1.5
"""Older tables of the first host do not count; it repeats them each half second."""

_SETTLES_S = 4.0
"""A replacement runs for so long at least, simulated seconds at rates below 1. A new detection
module is silent for some seconds, and silence twice as long stops the robot."""

_STEADY_S = 60.0
"""A host that is lost again so soon after its return is unstable."""

_UNSTABLE_S, _UNSTABLE_MAX_S = 10.0, 60.0
"""An unstable host is back after so long without a break; doubled by each loss, up to a maximum."""


class Home(NamedTuple):
    """Home of a unit: host, nodes of the unit, and whether it runs there or nowhere."""

    host: str
    nodes: tuple[str, ...]
    is_fixed: bool = False


@dataclass(slots=True)
class _Other:
    """What is known of another host. Times are real seconds.

    Attributes:
        seen_s: When a message of any of its guards arrived last.
        unbroken_s: Since when they have arrived without a break.
        steady_s: How long they must arrive without a break until the host is back.
        lost_s: When it was lost last.
        back_s: When it was back last.
        table_s: When its table arrived last.
        runs: Rows of that table by node.
    """

    seen_s: float
    unbroken_s: float
    steady_s: float
    lost_s: float = -math.inf
    back_s: float = -math.inf
    table_s: float = -math.inf
    is_lost: bool = False
    runs: dict[str, NodeInfo] = field(default_factory=dict)


class Changes(NamedTuple):
    """What follows from the times that have passed.

    Attributes:
        lost: Hosts that are lost since the last call.
        back: Hosts that are back.
        take: Units to start here, each with the number that its incarnation has to exceed.
        drop: Units to end here.
    """

    lost: tuple[str, ...] = ()
    back: tuple[str, ...] = ()
    take: tuple[tuple[str, int], ...] = ()
    drop: tuple[str, ...] = ()


class Placement:
    """What one supervisor runs.

    Args:
        own: Name of its host.
        homes: Home of each unit.
        guards: Host of each supervisor and router.
        link: When a host is lost, and when it is back.
        known: Returns the highest incarnation of a node that this host knows; 0 for none.
        now_s: Present time.
        rate: Simulated seconds per real second. Below 1 the other hosts publish less often.

    Attributes:
        held: Units that it runs.
    """

    def __init__(self, own: str, homes: Mapping[str, Home], guards: Mapping[str, str], link: Link,
                 known: Callable[[str], int], *, now_s: float, rate: float = 1.0) -> None:
        self.held = {unit for unit, home in homes.items() if home.host == own}
        self._own = own
        self._homes = homes
        self._known = known
        self._unit_of = {node: unit for unit, home in homes.items() for node in home.nodes}
        self._guards = guards
        slow = max(1.0, 1.0 / rate)
        self._lost_after_s, self._table_s = slow * link.lost_after_s, slow * _TABLE_S
        self._return_after_s, self._settles_s = link.return_after_s, slow * _SETTLES_S
        self._others = {
            name: _Other(now_s + _GRACE_S - self._lost_after_s, now_s, self._return_after_s)
            for name in guards.values() if name != own}

    def is_lost(self, host: str) -> bool:
        """Whether another host is lost."""
        return self._others[host].is_lost

    def begin(self, running: Collection[str], is_elsewhere: Callable[[str], bool]) -> list[str]:
        """Return the units to begin with: of this home, or running here already.

        If a unit of another home runs here, that host was lost. A unit of this home that may run on
        the first host is not begun; it will be given back.

        Args:
            running: Units that run here.
            is_elsewhere: Whether the last known process of a node is on another host.
        """
        for unit in running:
            if (host := self._homes[unit].host) != self._own:
                other = self._others[host]
                other.is_lost, other.seen_s = True, -math.inf
        self.held = {unit for unit, home in self._homes.items() if unit in running or (
            home.host == self._own and (home.is_fixed or not any(map(is_elsewhere, home.nodes))))}
        return [unit for unit in self._homes if unit in self.held]

    def excuse(self, now_s: float, missed_s: float) -> None:
        """Do not count a time in which this host could receive nothing as silence of others."""
        for other in self._others.values():
            other.seen_s = max(other.seen_s, min(now_s, other.seen_s + missed_s))
            other.unbroken_s = min(now_s, other.unbroken_s + missed_s)

    def note_alive(self, host: str, now_s: float) -> bool:
        """Note a message of a guard of another host; return whether the host was silent before."""
        other = self._others[host]
        was_silent = now_s - other.seen_s > self._lost_after_s
        if was_silent:
            other.unbroken_s = now_s
        other.seen_s = now_s
        return was_silent

    def take_table(self, host: str, rows: Iterable[NodeInfo], now_s: float
                   ) -> tuple[list[NodeInfo], list[str]]:
        """Take the table of another host's supervisor.

        Args:
            host: Name of the host.
            rows: Its table. Rows about nodes that it may not run are ignored. A row with another
                host's name only reports an issued incarnation, see `given_back`.
            now_s: Present time.

        Returns:
            Rows with a higher incarnation than known here, and the units to end here.
        """
        other = self._others[host]
        other.table_s = now_s
        accepted = [row for row in rows if self._may_run(host, row.name)]
        other.runs = {row.name: row for row in accepted if row.host == host}
        news = [row for row in accepted if row.incarnation > self._known(row.name)]
        superseded = {self._unit_of.get(row.name, "") for row in news}
        drop = [unit for unit in self._homes if unit in superseded & self.held]
        self.held.difference_update(drop)
        return news, drop

    def look(self, now_s: float, is_ready: Callable[[str], bool] = lambda _unit: True) -> Changes:
        """Return what has to change by now.

        Args:
            now_s: Present time.
            is_ready: Whether a unit that was given back can be started.
        """
        lost, back, drop = list[str](), list[str](), list[str]()
        take: list[tuple[str, int]] = []
        for host, other in self._others.items():
            is_silent = now_s - other.seen_s > self._lost_after_s
            if not other.is_lost and is_silent:
                other.is_lost, other.lost_s = True, now_s
                other.steady_s = self._return_after_s if now_s - other.back_s > _STEADY_S else min(
                    max(2 * other.steady_s, _UNSTABLE_S), _UNSTABLE_MAX_S)
                lost.append(host)
            elif (other.is_lost and not is_silent and now_s - other.unbroken_s >= other.steady_s
                  and now_s - other.lost_s >= self._settles_s):
                other.is_lost, other.back_s = False, now_s
                back.append(host)
            if self._own != FIRST:
                continue
            if not other.is_lost:
                drop += self._wanted_back(host, other)
            elif is_silent:
                take += [(unit, next_epoch(self._highest(unit))) for unit in self._homed(host)
                         if unit not in self.held and not self._homes[unit].is_fixed]
        if self._own != FIRST:
            take += [(unit, self._highest(unit)) for unit in self._returned(now_s)
                     if is_ready(unit)]
        self.held.update(unit for unit, _ in take)
        self.held.difference_update(drop)
        return Changes(tuple(lost), tuple(back), tuple(take), tuple(drop))

    def rows(self) -> list[NodeInfo]:
        """Return the rows of nodes that run on other hosts and not on this one."""
        return [row for other in self._others.values() for row in other.runs.values()
                if self._unit_of.get(row.name, "") not in self.held]

    def given_back(self) -> list[tuple[str, str, int]]:
        """Return the nodes that the first host has given back, as long as home is not above them.

        Until a home has received that incarnation, readers refuse what its own process publishes.

        Returns:
            Node, its home, and the highest incarnation known.
        """
        if self._own != FIRST:
            return []
        return [(node, home.host, self._known(node)) for unit, home in self._homes.items()
                if home.host != self._own and unit not in self.held for node in home.nodes
                if self._known(node) > self._runs_at(home.host, node)]

    def incarnations(self, unit: str) -> dict[str, int]:
        """Return the highest incarnation that is known here of each node of a unit."""
        return {node: self._known(node) for node in self._homes[unit].nodes}

    def _runs_at(self, host: str, node: str) -> int:
        row = self._others[host].runs.get(node)
        return row.incarnation if row else 0

    def _may_run(self, host: str, node: str) -> bool:
        """Whether a host may run a node: the first one all nodes, others those of their home."""
        unit = self._unit_of.get(node)
        if unit is None:
            return self._guards.get(node) == host
        return host in {FIRST, self._homes[unit].host}

    def _wanted_back(self, host: str, other: _Other) -> list[str]:
        """Return the units that run here and, by the table since its return, not at their home.

        A home that still runs its own has not received the higher incarnation yet: this host may
        receive it before it receives anything. No host would run what was given back then.
        """
        if other.table_s < other.unbroken_s:
            return []
        return [unit for unit in self._homed(host) if unit in self.held
                and other.runs.keys().isdisjoint(self._homes[unit].nodes)]

    def _homed(self, host: str) -> list[str]:
        return [unit for unit, home in self._homes.items() if home.host == host]

    def _highest(self, unit: str) -> int:
        return max(self.incarnations(unit).values())

    def _returned(self, now_s: float) -> list[str]:
        """Return the units of this home that run neither here nor, by its table, on the first."""
        first = self._others[FIRST]
        if now_s - first.table_s > self._table_s:
            return []
        return [unit for unit in self._homed(self._own) if unit not in self.held
                and first.runs.keys().isdisjoint(self._homes[unit].nodes)]
