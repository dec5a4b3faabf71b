"""Whether the machine keeps up with the rate of a run, from the lateness of event loops. Pure.

Each heartbeat carries the greatest lateness of its node's timers, and the supervisor's table passes
it on. The simulated world, whose timer steps the physics, reports it as well. Too little processor
time makes timers and messages late, and timeouts expire.

The limit is half the shortest slack of the system's timeouts: the time of each beyond the period of
its messages (`[timing]`). Half, since a message may be late at its sender and at its reader. A
lateness in real seconds is shorter in simulated ones at a lower rate. So the machine would have
kept up with `rate * allowed / late`, or with more, since there is less work at a lower rate.

Times are simulated seconds. In virtual time no loop is late.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Collection

import msgspec

from rampart.actors.ftm.messages import NodeTable
from rampart.manager.spec.budget import allowed_late_s
from rampart.manager.spec.tables import Timing

WINDOW_S = 2.0
"""Real seconds over which the largest lateness is taken."""

LINE_S = 5.0
"""Real seconds between two lines about it."""

_SHARE = 0.9
"""Quantile of the windows that decides about the rate, so a single hiccup does not count."""

_MOST = 10_000


class KeptUp(msgspec.Struct, frozen=True):
    """Result of a run.

    Attributes:
        rate: Requested rate, simulated seconds per second.
        with_rate: Rate that the machine would have kept up with, at most `rate`.
        late_s: Greatest lateness of a loop.
        node: Its node; "" if none was late.
        world_late_s: Greatest lateness of the simulated world.
        allowed_s: Permitted lateness.
        behind_s: For how long a loop was later than that.
    """

    rate: float
    with_rate: float
    late_s: float
    node: str
    world_late_s: float
    allowed_s: float
    behind_s: float

    def __str__(self) -> str:
        world = f", the world {1e3 * self.world_late_s:.0f} ms behind" if self.world_late_s else ""
        found = f"{self.with_rate:.2g}"
        what = (f"rate {self.rate:g} but for moments" if float(found) >= self.rate
                else f"rate {found}, not {self.rate:g}")
        return (f"this machine keeps up with {what}: event loops are up to "
                f"{1e3 * self.late_s:.0f} ms late ({self.node}){world}; allowed are "
                f"{1e3 * self.allowed_s:.0f} ms of simulated time")


class KeepingUp:
    """Measurement over a run.

    Args:
        timing: Table of the system.
        world: Nodes that simulate the world.
        rate: Simulated seconds per second.
        begins_s: Simulated time before which the system is starting.
    """

    def __init__(self, timing: Timing, world: Collection[str], rate: float,
                 begins_s: float = 0.0) -> None:
        self._allowed_s = allowed_late_s(timing)
        self._world = world
        self._rate = rate
        self._begins_s = begins_s
        self._until_s = self._line_s = -math.inf
        self._window = (0.0, "", 0.0)
        self._worst = (0.0, "", 0.0)
        self._late_s: deque[float] = deque(maxlen=_MOST)
        self._behind_s = 0.0

    def take(self, table: NodeTable, now_s: float) -> str:
        """Take a table of the nodes; return a line for people, "" for none."""
        if now_s < self._begins_s:
            return ""
        late_s, node = max(((row.late_s, row.name) for row in table.nodes), default=(0.0, ""))
        world_s = max((row.late_s for row in table.nodes if row.name in self._world), default=0.0)
        self._window = _worse(self._window, (late_s, node, world_s))
        if now_s < self._until_s:
            return ""
        line = self._close(now_s) if self._until_s > -math.inf else ""
        self._until_s = now_s + WINDOW_S * self._rate
        return line

    def _close(self, now_s: float) -> str:
        late_s, node, world_s = self._window
        self._worst = _worse(self._worst, self._window)
        self._late_s.append(late_s)
        self._window = (0.0, "", 0.0)
        if late_s <= self._allowed_s:
            return ""
        self._behind_s += now_s - self._until_s + WINDOW_S * self._rate
        if now_s < self._line_s + LINE_S * self._rate:
            return ""
        self._line_s = now_s
        return str(KeptUp(self._rate, self._with_rate(late_s), late_s, node, world_s,
                          self._allowed_s, 0.0))

    def _with_rate(self, late_s: float) -> float:
        return self._rate * min(1.0, self._allowed_s / late_s) if late_s > 0 else self._rate

    def result(self, now_s: float) -> KeptUp:
        """Return the result of a run that is over now."""
        if self._until_s > -math.inf:
            self._close(now_s)
        found = sorted(self._late_s)
        usual_s = found[math.ceil(_SHARE * len(found)) - 1] if found else 0.0
        late_s, node, world_s = self._worst
        return KeptUp(self._rate, self._with_rate(usual_s), late_s, node if late_s else "",
                      world_s, self._allowed_s, self._behind_s)


def _worse(one: tuple[float, str, float], other: tuple[float, str, float]
           ) -> tuple[float, str, float]:
    late_s, node, _ = max(one, other)
    return late_s, node, max(one[2], other[2])
