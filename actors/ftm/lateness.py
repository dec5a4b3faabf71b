"""How late the loops of the nodes were, by their heartbeats."""

from __future__ import annotations

from rampart.actors.bus.messages import ON_TIME


class Lateness:
    """The greatest lateness of each node in the last one or two periods; `turn` begins another."""

    def __init__(self) -> None:
        self._now: dict[str, float] = {}
        self._before: dict[str, float] = {}

    def note(self, node: str, late_s: float) -> None:
        """Note a heartbeat."""
        if late_s > self._now.get(node, 0.0):
            self._now[node] = late_s

    def turn(self) -> None:
        """Forget what is older than a period."""
        self._before, self._now = self._now, {}

    def count(self, late_s: float) -> int:
        """Return how many nodes were late by so many simulated seconds or more."""
        return sum(self.of(node) >= late_s for node in self._now.keys() | self._before.keys())

    def of(self, node: str) -> float:
        """Return by how many simulated seconds a node was late at most."""
        return max(self._now.get(node, 0.0), self._before.get(node, 0.0)) or ON_TIME
