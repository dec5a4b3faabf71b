"""The network of a virtual run: seeded delay, jitter, loss, duplication, reordering.

Zenoh carries the messages of one process to another over one TCP link, so without further ado
nothing is lost and nothing overtakes; `measured` is that. The other networks are for finding out
what the controller makes of worse ones.
"""

from __future__ import annotations

import random
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sim.timing import Timing, drawer, measured

__all__ = ["NETWORKS", "NetworkModel", "SeededNetwork", "find_network"]


@dataclass(frozen=True, slots=True)
class NetworkModel:
    """What a network does to messages.

    Args:
        name: As typed by the user.
        title: One line for people.
        delay: Whether messages take the measured time; else none.
        extra_s: Added to it, at most: a message is held up by a uniform share of it.
        loss: Probability that a copy never arrives.
        duplication: Probability that a second copy arrives.
        reordering: Probability that a message may be overtaken by those after it.
    """

    name: str
    title: str
    delay: bool = True
    extra_s: float = 0.0
    loss: float = 0.0
    duplication: float = 0.0
    reordering: float = 0.0

    def __post_init__(self) -> None:
        for field in ("loss", "duplication", "reordering"):
            if not 0 <= getattr(self, field) <= 1:
                raise ValueError(f"{field} = {getattr(self, field)}: must be between 0 and 1")
        if not 0 <= self.extra_s < 60:
            raise ValueError(f"extra_s = {self.extra_s}: must be between 0 and 60")


NETWORKS: Mapping[str, NetworkModel] = {model.name: model for model in (
    NetworkModel("measured", "as between processes on one machine over Zenoh"),
    NetworkModel("ideal", "no delay at all", delay=False),
    NetworkModel("jittery", "up to 20 ms more, in order", extra_s=0.02),
    NetworkModel("lossy", "as between robots: up to 20 ms more, 1 % lost, 1 % twice, 2 % overtaken",
                 extra_s=0.02, loss=0.01, duplication=0.01, reordering=0.02),
)}
"""Networks by name."""


def find_network(name: str) -> NetworkModel:
    """Return a network by name.

    Raises:
        ValueError: There is none.
    """
    try:
        return NETWORKS[name]
    except KeyError:
        raise ValueError(f"unknown network {name!r}; known: {', '.join(NETWORKS)}") from None


class SeededNetwork:
    """Says when messages arrive; the same seed and the same questions give the same answers.

    Args:
        model: What it does to messages.
        seed: Of all its dice.
        timing: Distribution of the delay; the measured one if None.
        local: Nodes that share a process with everybody: nothing happens on the way to them.
    """

    def __init__(self, model: NetworkModel, seed: Any, timing: Timing | None = None,
                 local: Sequence[str] = ()) -> None:
        self.model = model
        self.lost = self.duplicated = self.overtaken = 0
        self._rng = random.Random(f"network {seed}")  # noqa: S311 no secret
        self._delay_s = drawer((timing or measured()).message_ms, self._rng)
        self._local = frozenset(local)
        self._last: dict[tuple[str, str], float] = {}
        self._plain = not (model.loss or model.duplication or model.reordering)

    def arrivals(self, source: str, reader: str, now_s: float) -> Sequence[float]:
        """Return the times at which copies of a message sent now arrive; none if it is lost."""
        if reader in self._local or source in self._local:
            return (now_s,)
        if self._plain:
            return (self._arrival((source, reader), now_s),)
        model, dice = self.model, self._rng.random
        if dice() < model.loss:
            self.lost += 1
            return ()
        if dice() < model.duplication:
            self.duplicated += 1
            link = (source, reader)
            return (self._arrival(link, now_s), self._arrival(link, now_s))
        return (self._arrival((source, reader), now_s),)

    def _arrival(self, link: tuple[str, str], now_s: float) -> float:
        model = self.model
        at_s = now_s
        if model.delay:
            at_s += self._delay_s()
        if model.extra_s:
            at_s += model.extra_s * self._rng.random()
        last_s = self._last.get(link, 0.0)
        if at_s < last_s:
            if model.reordering and self._rng.random() < model.reordering:
                self.overtaken += 1
                return at_s
            at_s = last_s
        self._last[link] = at_s
        return at_s
