"""Which rate `--rate max` takes, for machines that keep up with one and are late above it."""

from __future__ import annotations

import asyncio

import pytest

from rampart.sim.runs.keeping_up import KeptUp
from rampart.sim.runs.rate_search import LEAST, MOST, find_rate


def search(limit: float, first: float = 2.0) -> tuple[float, list[float], list[str]]:
    """Return the rate that is taken, those that were tried, and what was told."""
    tried: list[float] = []
    told: list[str] = []

    async def probe(rate: float) -> KeptUp:
        tried.append(rate)
        late_s = 0.15 * (rate / limit) ** 2  # lateness grows faster than the rate
        return KeptUp(rate, rate * min(1.0, 0.15 / late_s), late_s, "a", 0.0, 0.15, 0.0)

    return asyncio.run(find_rate(probe, told.append, first)), tried, told


@pytest.mark.parametrize(("limit", "tried", "taken"), [
    (2.3, [2.0, 4.0], 1.6),
    (5.0, [2.0, 4.0, 8.0], 3.2),
    (1.5, [2.0, 1.1], 0.8),
    (0.7, [2.0, 0.2, 0.4, 0.8], 0.3),
    (1000.0, [2.0, 4.0, 8.0, 16.0, MOST], 16.0),
    (0.001, [2.0, LEAST], LEAST)])
def test_it_takes_less_than_the_highest_rate_with_which_the_machine_kept_up(limit, tried, taken):
    rate, found, told = search(limit)
    assert found == pytest.approx(tried)
    assert rate == pytest.approx(taken)
    assert len(told) == len(tried)


def test_it_says_what_it_tried():
    _, _, told = search(2.3)
    assert told == [
        "rate 2 tried: this machine keeps up (loops up to 113 ms late, 150 are in order)",
        "rate 4 tried: this machine does not keep up (loops up to 454 ms late, 150 are in order)"]
