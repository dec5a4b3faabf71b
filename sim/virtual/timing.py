"""How long things take between processes, as measured on real ones and kept in `timing.toml`.

In virtual time nothing takes any time by itself. What passes between the sending of a message and
its arrival, between a death and its discovery, between a fork and the new process's first word,
is drawn from the distributions that `python -m benchmarks.timing` has measured.
"""

from __future__ import annotations

import random
import tomllib
from collections.abc import Callable
from functools import lru_cache
from itertools import pairwise
from pathlib import Path

import msgspec
import numpy as np

_FILE = Path(__file__).with_name("timing.toml")


class Timing(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Distributions as quantiles: evenly spaced from the minimum to the maximum, milliseconds.

    Attributes:
        message_ms: From sending to the reader's mailbox.
        death_ms: From SIGKILL to the readers of the liveliness token.
        exit_ms: From SIGKILL to the supervisor, by pidfd.
        start_ms: From fork to the new process's first message.
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
