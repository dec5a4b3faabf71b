"""The network of a virtual run: seeded, measured, and with the faults of its model."""

from __future__ import annotations

from collections import Counter
from itertools import pairwise

import numpy as np
import pytest

from rampart.sim.virtual.network import NETWORKS, NetworkModel, SeededNetwork, Timing


def ways(network: SeededNetwork, count: int = 4000, step_s: float = 0.001):
    link = network.link("a", "b")
    return [(i * step_s, link(i * step_s)) for i in range(count)]


def test_the_same_seed_gives_the_same_arrivals_and_another_seed_others():
    model = NETWORKS["lossy"]
    assert ways(SeededNetwork(model, 1)) == ways(SeededNetwork(model, 1))
    assert ways(SeededNetwork(model, 1)) != ways(SeededNetwork(model, 2))


def test_over_one_link_nothing_is_lost_nothing_comes_twice_and_nothing_overtakes():
    for name in ("measured", "jittery"):
        arrivals = [at for _, at in ways(SeededNetwork(NETWORKS[name], 3))]
        assert all(len(at) == 1 for at in arrivals)
        times = [at[0] for at in arrivals]
        assert times == sorted(times)
    for model in NETWORKS.values():
        assert all(at >= sent for sent, found in ways(SeededNetwork(model, 4)) for at in found)


def test_delays_are_drawn_from_the_measured_distribution():
    quantiles = (1.0, 2.0, 10.0)
    link = SeededNetwork(NETWORKS["measured"], 5, Timing(quantiles, *[(1.0, 1.0)] * 4)
                         ).link("a", "b")
    delays = [(link(i)[0] - i) * 1e3 for i in range(4000)]
    for value in (1.5, 2.0, 6.0):
        below = sum(delay < value for delay in delays) / len(delays)
        assert below == pytest.approx(np.interp(value, quantiles, (0.0, 0.5, 1.0)), abs=0.03)
    assert min(delays) + 1e-6 >= 1.0
    assert 9.9 < max(delays) <= 10.0 + 1e-6


def test_loss_duplication_and_overtaking_come_as_often_as_said():
    network = SeededNetwork(NetworkModel(
        "x", "", extra_s=0.05, loss=0.1, duplication=0.2, reordering=1.0), 6)
    found = [at for _, at in ways(network, 10_000)]
    copies = Counter(map(len, found))
    assert copies[0] / 10_000 == pytest.approx(0.1, abs=0.01)
    assert copies[2] / 10_000 == pytest.approx(0.9 * 0.2, abs=0.015)
    times = [at[0] for at in found if at]
    assert sum(later < earlier for earlier, later in pairwise(times)) > 1000


def test_the_observer_receives_messages_at_once_on_any_network():
    network = SeededNetwork(NetworkModel("x", "", loss=1.0), 1, local=("observer",))
    assert network.link("a", "observer") is None
    assert network.link("observer", "a") is None
    assert network.link("a", "b")(5.0) == ()
