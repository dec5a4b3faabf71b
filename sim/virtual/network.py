"""The network of a virtual run, and how long things take between its processes.

In virtual time nothing takes any time by itself. What passes between the sending of a message and
its arrival, between a death and its discovery, between a fork and the new process's first word, is
drawn from the distributions that `python -m benchmarks.timing` has measured (`timing.toml`).

Zenoh carries the messages of one process to another over one TCP link, so without further ado
nothing is lost and nothing overtakes; `measured` is that. The other networks are for finding out
what the controller makes of worse ones.
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
import numpy as np

from rampart.sim.virtual.virtual_bus import Link


class NetworkModel(msgspec.Struct, frozen=True):
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
                 extra_s=0.02, loss=0.01, duplication=0.01, reordering=0.02))}
"""Networks by name."""


def find_network(name: str) -> NetworkModel:
    """Return a network by name.

    Raises:
        ValueError: There is none.
    """
    if name not in NETWORKS:
        raise ValueError(f"unknown network {name!r}; known: {', '.join(NETWORKS)}")
    return NETWORKS[name]


class SeededNetwork:
    """Says when messages arrive; the same seed and the same questions give the same answers.

    Args:
        model: What it does to messages.
        seed: Of all its dice.
        timing: Distribution of the delay; the measured one if None.
        local: Nodes that share a process with all others: nothing happens on the way to them.
    """

    def __init__(self, model: NetworkModel, seed: Any, timing: Timing | None = None,
                 local: Sequence[str] = ()) -> None:
        self.model = model
        self._rng = random.Random(f"network {seed}")  # noqa: S311 no secret
        delays_ms = (timing or measured()).message_ms
        self._delay_s = drawer(delays_ms, self._rng)
        self._stock = Stock(delays_ms, self._rng)
        self._local = frozenset(local)
        self._links: dict[tuple[str, str], Link] = {}

    def link(self, source: str, reader: str) -> Link | None:
        """Return the one link between two nodes; None if everything arrives at once."""
        if source in self._local or reader in self._local:
            return None
        ends, model = (source, reader), self.model
        if ends not in self._links:
            plain = not (model.extra_s or model.loss or model.duplication or model.reordering)
            self._links[ends] = self._in_order() if plain and model.delay else self._troubled()
        return self._links[ends]

    def _in_order(self) -> Link:
        """Return a link that delays messages and does no more: most runs have only these."""
        fill, delays_s, last_s = self._stock.fill, self._stock.draws_s, 0.0

        def arrivals(now_s: float) -> Sequence[float]:
            nonlocal last_s
            if not delays_s:
                fill()
            at_s = now_s + delays_s.pop()
            last_s = at_s if at_s > last_s else last_s
            return (last_s,)

        return arrivals

    def _troubled(self) -> Link:
        """Return a link that does to messages what the model says."""
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
        message_ms: From sending to the reader's mailbox.
        death_ms: From SIGKILL to those who watch the node: what the supervisor says, or the token.
        exit_ms: From SIGKILL to the supervisor, by pidfd.
        start_ms: From when a process is to be started to its first message: the fork, or the spare.
        supervisor_back_ms: From the supervisor's SIGKILL to its successor's fork.
    """

    message_ms: tuple[float, ...]
    death_ms: tuple[float, ...]
    exit_ms: tuple[float, ...]
    start_ms: tuple[float, ...]
    supervisor_back_ms: tuple[float, ...]

    def __post_init__(self) -> None:
        for name in self.__struct_fields__:
            values = getattr(self, name)
            if len(values) < 2 or values[0] < 0 or list(values) != sorted(values):
                raise ValueError(f"{name} = {values}: must be two or more ascending milliseconds")


@lru_cache(maxsize=1)
def measured() -> Timing:
    """Return what was measured."""
    with _FILE.open("rb") as file:
        return msgspec.convert(tomllib.load(file), Timing)


def drawer(quantiles_ms: tuple[float, ...], rng: random.Random) -> Callable[[], float]:
    """Return a function that draws from a distribution: linear between its quantiles; seconds."""
    pieces = [(here, there - here) for here, there in pairwise(quantiles_ms)]
    share, count = rng.random, len(pieces)

    def next_s() -> float:
        at = share() * count
        low = int(at)
        here, rise = pieces[low]
        return (here + rise * (at - low)) * 1e-3

    return next_s


class Stock:
    """Draws in stock, bit by bit those of a `drawer` that has the dice for itself alone.

    numpy's older generator is the same as Python's, and makes a block at once.

    Args:
        quantiles_ms: As for `drawer`.
        rng: The dice, whose further throws are drawn from a copy.
    """

    BLOCK = 2048

    def __init__(self, quantiles_ms: tuple[float, ...], rng: random.Random) -> None:
        self.draws_s: list[float] = []
        self._low_ms = np.array(quantiles_ms[:-1])
        self._rise_ms = np.diff(quantiles_ms)
        _, (*words, used), _ = rng.getstate()
        self._dice = np.random.RandomState()
        self._dice.set_state(("MT19937", np.array(words, dtype=np.uint32), used, 0, 0.0))

    def fill(self) -> None:
        """Put the next block into the empty `draws_s`, the last one first."""
        at = self._dice.random_sample(self.BLOCK) * len(self._low_ms)
        low = at.astype(int)
        block_s = (self._low_ms[low] + self._rise_ms[low] * (at - low)) * 1e-3
        self.draws_s += block_s[::-1].tolist()
