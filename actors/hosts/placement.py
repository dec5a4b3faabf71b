"""Which of a system's processes a supervisor runs, when there are several hosts. Pure.

Each process has a home. While a host is lost, nothing being heard of its supervisor and its
routers, the first host, the robot's, runs what has its home there; when it has been back for a
while, the first host lets go of that, and the home starts it anew. No agreement is needed for it,
for two rules hold at any time:

* **The highest incarnation counts.** What the first host starts in another one's place has an
  incarnation that its home cannot have reached meanwhile (`next_epoch`). A supervisor that receives
  a higher one than its own lets go of the process, and all readers on its host refuse lower ones.
* **Only the first host takes over.** A home that hears nothing of the first goes on with what it
  has, which then only those can hear who are cut off with it.

A link may carry one way before it does the other, and go again. So nothing is given back to a home
that says that it still runs its own, and the first host says which incarnation it has given back
until the home runs a higher one (`given_back`): whatever got lost, in the end both know.

So a recovery module obeys one manager at any time: that of the highest incarnation it can hear of.
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
"""A host that was not heard yet since this supervisor began is not lost for so long: it starts."""

_TABLE_S = 1.5
"""A table of the first host is repeated each half second; older, it says nothing any more."""


_SETTLES_S = 4.0
"""What was started in another place is not replaced again for so long, simulated seconds at a rate
below 1: a detection module that is new is silent until it knows, up to some seconds, and silence
twice as long stops the robot."""

_STEADY_S = 60.0
"""A host that is lost again so soon after it was back flaps, ..."""

_FLAPPING_S = 10.0
"""... and then is back when it has been heard without a break for so long, each time for twice as
long, ..."""

_FLAPPING_MAX_S = 60.0
"""... and for so long at most."""


class Home(NamedTuple):
    """Where a unit belongs.

    Attributes:
        host: Name of the host.
        nodes: Of the unit.
        is_fixed: Whether it runs there or nowhere.
    """

    host: str
    nodes: tuple[str, ...]
    is_fixed: bool = False


@dataclass(slots=True)
class _Other:
    """What is known of another host. Times are real seconds.

    Attributes:
        heard_s: When any of its guards was heard.
        since_s: Since when they have been heard without a break.
        lost_s: When it was lost last.
        back_s: When it was back last.
        steady_s: For how long it has to be heard to be back.
        told_s: When its supervisor said what it runs.
        runs: That, each node with its incarnation.
    """

    heard_s: float
    since_s: float
    steady_s: float
    lost_s: float = -math.inf
    back_s: float = -math.inf
    told_s: float = -1e12
    is_lost: bool = False
    runs: dict[str, NodeInfo] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Changes:
    """What follows from a look at the others.

    Attributes:
        lost: Hosts that are lost since the last look.
        back: Hosts that are back.
        take: Units to be started here, each with the number that its incarnation has to exceed.
        drop: Units to be let go.
    """

    lost: tuple[str, ...] = ()
    back: tuple[str, ...] = ()
    take: tuple[tuple[str, int], ...] = ()
    drop: tuple[str, ...] = ()


class Placement:
    """What one supervisor runs.

    Args:
        own: Name of its host.
        homes: Where each unit belongs.
        guards: Name of each supervisor and router with that of its host.
        link: When a host is lost, and when it is back.
        known: Returns the highest incarnation of a node that is known on this host, 0 if none is.
        now_s: Now.
        rate: Simulated seconds in a real one: at less than 1 others speak more rarely.

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
        """Whether a host is lost."""
        return host != self._own and self._others[host].is_lost

    def is_fixed(self, unit: str) -> bool:
        """Whether a unit runs at its home or nowhere."""
        return self._homes[unit].is_fixed

    def begin(self, running: Collection[str], is_elsewhere: Callable[[str], bool]) -> list[str]:
        """Return the units to begin with: those of this host, and what runs here already.

        A host is lost, as far as is known, if what has its home there runs here. What may run
        on the first host in place of this one will be given back.

        Args:
            running: Units that run here.
            is_elsewhere: Asked of a node: whether its last known process is on another host.
        """
        for unit in running:
            if (host := self._homes[unit].host) != self._own:
                other = self._others[host]
                other.is_lost, other.heard_s = True, -math.inf
        self.held = {unit for unit, home in self._homes.items() if unit in running or (
            home.host == self._own and (home.is_fixed or not any(map(is_elsewhere, home.nodes))))}
        return [unit for unit in self._homes if unit in self.held]

    def excuse(self, now_s: float, missed_s: float) -> None:
        """Do not count as silence of the others a time in which nothing could be received here."""
        for other in self._others.values():
            other.heard_s = max(other.heard_s, min(now_s, other.heard_s + missed_s))
            other.since_s = min(now_s, other.since_s + missed_s)

    def heard(self, host: str, now_s: float) -> bool:
        """Note that a guard of another host was heard; return whether that was missed before."""
        other = self._others[host]
        was_missed = now_s - other.heard_s > self._lost_after_s
        if was_missed:
            other.since_s = now_s
        other.heard_s = now_s
        return was_missed

    def told(self, host: str, rows: Iterable[NodeInfo], now_s: float
             ) -> tuple[list[NodeInfo], list[str]]:
        """Take what the supervisor of another host runs.

        Args:
            host: Its name.
            rows: What it publishes; of nodes that are not its own to run, nothing is believed. A
                row with another host's name says what was issued, see `given_back`.
            now_s: Now.

        Returns:
            The rows with an incarnation higher than known here, and the units to be let go.
        """
        other = self._others[host]
        other.told_s = now_s
        believed = [row for row in rows if self._may_run(host, row.name)]
        other.runs = {row.name: row for row in believed if row.host == host}
        news = [row for row in believed if row.incarnation > self._known(row.name)]
        superseded = {self._unit_of.get(row.name, "") for row in news}
        drop = [unit for unit in self._homes if unit in superseded & self.held]
        self.held.difference_update(drop)
        return news, drop

    def look(self, now_s: float, is_ready: Callable[[str], bool] = lambda _unit: True) -> Changes:
        """Return what is to be done.

        Args:
            now_s: Now.
            is_ready: Asked of a unit that was given back: whether it can be started.
        """
        lost, back, drop = list[str](), list[str](), list[str]()
        take: list[tuple[str, int]] = []
        for host, other in self._others.items():
            is_silent = now_s - other.heard_s > self._lost_after_s
            if not other.is_lost and is_silent:
                other.is_lost, other.lost_s = True, now_s
                other.steady_s = self._return_after_s if now_s - other.back_s > _STEADY_S else min(
                    max(2 * other.steady_s, _FLAPPING_S), _FLAPPING_MAX_S)
                lost.append(host)
            elif (other.is_lost and not is_silent and now_s - other.since_s >= other.steady_s
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
        """Return what the others run, and no one here does."""
        return [row for other in self._others.values() for row in other.runs.values()
                if self._unit_of.get(row.name, "") not in self.held]

    def given_back(self) -> list[tuple[str, str, int]]:
        """Return what the first host does not run, as long as its home runs a lower one than known.

        Until a home has received that number, all that its own node publishes is refused.

        Returns:
            Node, its home, and the highest incarnation that is known.
        """
        if self._own != FIRST:
            return []
        return [(node, home.host, self._known(node)) for unit, home in self._homes.items()
                if home.host != self._own and unit not in self.held for node in home.nodes
                if self._known(node) > self._runs_at(home.host, node)]

    def told_of(self, unit: str) -> dict[str, int]:
        """Return the highest incarnation of each node of a unit that is known here."""
        return {node: self._known(node) for node in self._homes[unit].nodes}

    def _runs_at(self, host: str, node: str) -> int:
        row = self._others[host].runs.get(node)
        return row.incarnation if row else 0

    def _may_run(self, host: str, node: str) -> bool:
        """Whether a host may speak of a node: the first of those of all, another of its own.

        Of its supervisor and routers each alone, and nobody of what is neither.
        """
        unit = self._unit_of.get(node)
        if unit is None:
            return self._guards.get(node) == host
        return host in {FIRST, self._homes[unit].host}

    def _wanted_back(self, host: str, other: _Other) -> list[str]:
        """Return what is run here and no more at home, as its supervisor says since it is back.

        One that still has its own has not heard yet that there is a higher incarnation. It may be
        heard here before it hears anything; what was given back then would be run by nobody.
        """
        if other.told_s < other.since_s:
            return []
        return [unit for unit in self._homed(host) if unit in self.held
                and other.runs.keys().isdisjoint(self._homes[unit].nodes)]

    def _homed(self, host: str) -> list[str]:
        return [unit for unit, home in self._homes.items() if home.host == host]

    def _highest(self, unit: str) -> int:
        return max(map(self._known, self._homes[unit].nodes))

    def _returned(self, now_s: float) -> list[str]:
        """Return what has its home here and is not run: the first host does not list it (more)."""
        first = self._others[FIRST]
        if now_s - first.told_s > self._table_s:
            return []
        return [unit for unit in self._homed(self._own) if unit not in self.held
                and first.runs.keys().isdisjoint(self._homes[unit].nodes)]
