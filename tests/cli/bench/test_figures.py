"""Statistics of the benchmark, and what it reads from the kernel."""

from __future__ import annotations

import pytest

from rampart.cli.bench.figures import Kill, Spread, killed, quantile, ratio, ratios, spread
from rampart.cli.bench.size import memory_in, ticks_of


def test_quantiles_lie_between_the_samples():
    assert [quantile([1.0, 2.0, 4.0], share) for share in (0, 0.25, 0.5, 1)] == [1, 1.5, 2, 4]
    assert quantile([7.0], 0.95) == 7


@pytest.mark.parametrize(("samples", "share"), [([], 0.5), ([1.0], 1.1), ([1.0], -0.1)])
def test_there_is_no_quantile_of_nothing(samples, share):
    with pytest.raises(ValueError, match="quantile"):
        quantile(samples, share)


def test_a_spread_leaves_out_what_was_not_observed():
    assert spread([None, 3.0, 1.0, None, 2.0]) == Spread(3, 2.0, 1.1, 2.9)
    assert spread([None]) is None


def test_ratios_are_of_the_same_round():
    assert ratios([2.0, 30.0, None], [1.0, 10.0, 5.0]) == Spread(2, 2.5, 2.05, 2.95)
    assert ratios([1.0], [0.0]) is None
    assert ratios([1.0, 2.0], []) is None


def test_a_ratio_needs_both():
    of, to = Spread(1, 3.0, 3.0, 3.0), Spread(1, 2.0, 2.0, 2.0)
    assert (ratio(of, to), ratio(of, None), ratio(None, to)) == (1.5, None, None)


def test_a_row_has_the_spreads_of_its_kills():
    row = killed("dora", "dora", [Kill(1.0, None, 20.0, 100.0), Kill(None, None, 30.0, 300.0)],
                 beside=[Kill(output=10.0), Kill(output=10.0)])
    assert row.detected_ms == Spread(1, 1.0, 1.0, 1.0)
    assert row.decided_ms is None
    assert row.begun_ms.median == 25.0
    assert row.output_ms.median == 200.0
    assert row.times.median == 20.0


def test_processor_time_is_read_behind_a_name_with_brackets():
    stat = "12 (a) b (c) S 1 12 12 0 -1 4194560 1 0 0 0 25 17 0 0 20 0 1 0 5 1 1"
    assert ticks_of(stat) == 42


def test_memory_is_read_from_the_kernels_sum():
    rollup = ("5581c0000000-7ffd5e1ff000 ---p 00000000 00:00 0    [rollup]\n"
              "Rss:    9000 kB\nPss:    500 kB\nPss_Anon:   30 kB\n"
              "Private_Clean:   100 kB\nPrivate_Dirty:   200 kB\n")
    assert memory_in(rollup) == (512_000, 307_200)
