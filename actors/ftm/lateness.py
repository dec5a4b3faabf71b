"""Lateness of the nodes' loops, by their heartbeats."""

from __future__ import annotations

from rampart.actors.bus.messages import ON_TIME


class Lateness:
    """Greatest lateness of each node in the last one or two periods; `turn` begins a period."""

    def __init__(self) -> None:
        self._now: dict[str, float] = {}
        self._before: dict[str, float] = {}

    def note(self, node: str, late_s: float) -> None:
        """Note a heartbeat."""
        if late_s > self._now.get(node, 0.0):
            self._now[node] = late_s

    def turn(self) -> None:
        """Forget the period before the last one."""
        self._before, self._now = self._now, {}

    def count(self, late_s: float) -> int:
        """Return the number of nodes that were at least this late, simulated seconds."""
        return sum(self.of(node) >= late_s for node in self._now.keys() | self._before.keys())

    def of(self, node: str) -> float:
        """Return the greatest lateness of a node, simulated seconds."""
        return max(self._now.get(node, 0.0), self._before.get(node, 0.0)) or ON_TIME
