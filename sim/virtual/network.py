"""The network of a virtual run, and the delays between its processes.

In virtual time nothing takes time by itself. The delays of messages, of the discovery of a death,
and of the start of a process are drawn from the distributions that `python -m benchmarks.timing`
measured (`timing.toml`).

Zenoh carries the messages between two processes over one link, so none is lost or overtaken. The
network `measured` models this. The other networks test the controller under worse conditions.
"""

from __future__ import annotations

import random
import tomllib
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec

from rampart.sim.virtual.virtual_bus import Link


class NetworkModel(msgspec.Struct, frozen=True):
    """Delays and faults of a network.

    Args:
        name: Name on the command line.
        title: One line for people.
        delay: Whether messages take the measured time; if not, none.
        extra_s: Largest further delay; a message takes a uniform share of it.
        loss: Probability that a copy never arrives.
        duplication: Probability that a second copy arrives.
        reordering: Probability that later messages may overtake a message.
    """

    name: str
    title: str
    delay: bool = True
    extra_s: float = 0.0
    loss: float = 0.0
    duplication: float = 0.0
    reordering: float = 0.0


NETWORKS: Mapping[str, NetworkModel] = {model.name: model for model in (
    NetworkModel("measured", "as between processes on one machine over Zenoh"),
    NetworkModel("ideal", "no delay at all", delay=False),
    NetworkModel("jittery", "up to 20 ms more, in order", extra_s=0.02),
    NetworkModel("lossy", "as between robots: up to 20 ms more, 1 % lost, 1 % twice, 2 % overtaken",
                 extra_s=0.02, loss=0.01, duplication=0.01, reordering=0.02))}
"""Networks by name."""


def find_network(name: str) -> NetworkModel:
    """Return a network by name.

    Raises:
        ValueError: The name is unknown.
    """
    if name not in NETWORKS:
        raise ValueError(f"unknown network {name!r}; known: {', '.join(NETWORKS)}")
    return NETWORKS[name]


class SeededNetwork:
    """Draws the arrival times of messages, reproducibly from a seed.

    Args:
        model: Delays and faults of the network.
        seed: Seed of all draws.
        timing: Distribution of the delay; the measured one if None.
        local: Nodes that share a process with all others; their messages take no time.
    """

    def __init__(self, model: NetworkModel, seed: Any, timing: Timing | None = None,
                 local: Sequence[str] = ()) -> None:
        self.model = model
        self._rng = random.Random(f"network {seed}")  # noqa: S311 no secret
        self._delay_s = drawer((timing or measured()).message_ms, self._rng)
        self._local = frozenset(local)
        self._links: dict[tuple[str, str], Link] = {}

    def link(self, source: str, reader: str) -> Link | None:
        """Return the link between two nodes; None if messages arrive at once."""
        if source in self._local or reader in self._local:
            return None
        ends = source, reader
        if ends not in self._links:
            self._links[ends] = self._new_link()
        return self._links[ends]

    def _new_link(self) -> Link:
        model, dice, last_s = self.model, self._rng.random, 0.0

        def arrivals(now_s: float) -> Sequence[float]:
            if model.loss and dice() < model.loss:
                return ()
            if model.duplication and dice() < model.duplication:
                return (arrival(now_s), arrival(now_s))
            return (arrival(now_s),)

        def arrival(now_s: float) -> float:
            nonlocal last_s
            at_s = now_s
            if model.delay:
                at_s += self._delay_s()
            if model.extra_s:
                at_s += model.extra_s * dice()
            if at_s < last_s:
                if model.reordering and dice() < model.reordering:
                    return at_s
                at_s = last_s
            last_s = at_s
            return at_s

        return arrivals


_FILE = Path(__file__).with_name("timing.toml")


class Timing(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Distributions as quantiles: evenly spaced from the minimum to the maximum, milliseconds.

    Attributes:
        message_ms: From sending a message to the reader's mailbox.
        death_ms: From SIGKILL to the readers of the supervisor's report.
        exit_ms: From SIGKILL to the supervisor's pidfd.
        start_ms: From the request for a process, forked or from the pool, to its first message.
        supervisor_back_ms: From the supervisor's SIGKILL to its successor's fork.
    """

    message_ms: tuple[float, ...]
    death_ms: tuple[float, ...]
    exit_ms: tuple[float, ...]
    start_ms: tuple[float, ...]
    supervisor_back_ms: tuple[float, ...]


@lru_cache(maxsize=1)
def measured() -> Timing:
    """Return the measured distributions."""
    with _FILE.open("rb") as file:
        return msgspec.convert(tomllib.load(file), Timing)


def drawer(quantiles_ms: tuple[float, ...], rng: random.Random) -> Callable[[], float]:
    """Return a function that draws seconds from a distribution, linear between its quantiles."""
    pieces = [(here, there - here) for here, there in pairwise(quantiles_ms)]
    share, count = rng.random, len(pieces)

    def next_s() -> float:
        at = share() * count
        low = int(at)
        here, rise = pieces[low]
        return (here + rise * (at - low)) * 1e-3

    return next_s
