"""Drawing all the time is faster, and gives the same numbers."""

import random

from hypothesis import given
from hypothesis import strategies as st

from rampart.sim.virtual.network import Stock, drawer


@given(st.lists(st.floats(0, 1e4), min_size=2, max_size=40).map(sorted), st.integers(),
       st.integers(0, 5))
def test_a_stock_gives_bit_by_bit_what_a_drawer_gives_from_one_block_to_the_next(
        quantiles, seed, used):
    one, other = random.Random(seed), random.Random(seed)
    for rng in (one, other):
        for _ in range(used):
            rng.random()
    stock, drawn = Stock(tuple(quantiles), one), []
    for _ in range(stock.BLOCK + 20):
        if not stock.draws_s:
            stock.fill()
        drawn.append(stock.draws_s.pop())
    next_s = drawer(tuple(quantiles), other)
    assert drawn == [next_s() for _ in range(stock.BLOCK + 20)]
