"""Drawing all the time is faster, and gives the same numbers."""

import random

from hypothesis import given
from hypothesis import strategies as st

from sim.timing import draw, drawer


@given(st.lists(st.floats(0, 1e4), min_size=2, max_size=40).map(sorted), st.integers())
def test_a_drawer_gives_bit_by_bit_what_draw_gives(quantiles, seed):
    one, other = random.Random(seed), random.Random(seed)
    next_s = drawer(tuple(quantiles), one)
    assert [next_s() for _ in range(20)] == [draw(tuple(quantiles), other) for _ in range(20)]
