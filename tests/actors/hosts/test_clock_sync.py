"""Offset of another host's clock: the bound holds whatever the network does; jumps are noticed."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rampart.actors.bus.envelope import AHEAD_S
from rampart.actors.hosts.clock_sync import DRIFT, ClockSync
from rampart.manager.spec.specification import parse_specification
from rampart.manager.spec.tables import SpecificationError
from tests.two_hosts import two_hosts


def exchange(sync: ClockSync, at_s: float, ahead_s: float, there_s: float, back_s: float) -> None:
    sync.add_exchange(at_s, at_s + there_s + ahead_s, at_s + there_s + back_s)


@given(st.floats(-1e6, 1e6), st.lists(
    st.tuples(st.floats(1e-5, 5.0), st.floats(1e-5, 5.0)), min_size=1, max_size=80),
    st.floats(-DRIFT / 2, DRIFT / 2))
def test_the_true_offset_lies_within_the_bound(ahead_s, ways, drift):
    sync, now_s = ClockSync(), 0.0
    for there_s, back_s in ways:
        told_s = now_s + there_s
        sync.add_exchange(now_s, told_s + ahead_s + drift * told_s, told_s + back_s)
        now_s = told_s + back_s
        true_s = ahead_s + drift * now_s
        assert abs(sync.offset_s - true_s) <= sync.bound_s + 1e-6
        now_s += 0.25


def test_the_quickest_way_there_and_the_quickest_way_back_count_together():
    sync = ClockSync()
    exchange(sync, 0.0, 100.0, 0.001, 0.4)
    exchange(sync, 1.0, 100.0, 0.4, 0.001)
    for second in range(2, 300):
        exchange(sync, float(second), 100.0, 0.3, 0.3)
        if second == 50:
            assert sync.bound_s < 0.25  # on its way: it never jumps
    assert sync.offset_s == pytest.approx(100.0, abs=0.2)


@pytest.mark.parametrize("slow_way", [0, 1])
def test_a_way_that_becomes_quicker_does_not_leave_a_clock_that_readers_refuse(slow_way):
    sync = ClockSync(0.1)
    ways = [0.001, 0.001]
    ways[slow_way] = 0.5
    for turn in range(100):
        exchange(sync, turn / 4, 5.0, *ways)
    for turn in range(100, 104):
        exchange(sync, turn / 4, 5.0, 0.001, 0.001)
        assert abs(sync.offset_s - 5.0) <= AHEAD_S


def test_no_bound_of_two_clocks_is_accepted_that_readers_of_messages_do_not_tolerate():
    text = two_hosts({"robot": "10.0.0.1", "ground": "10.0.0.2"})
    assert parse_specification(text, "two.toml").link.clock_s <= AHEAD_S
    with pytest.raises(SpecificationError, match=r"link.*clock_s = 2"):
        parse_specification(text.replace("[link]\n", "[link]\nclock_s = 2\n"), "two.toml")


def test_after_a_jump_of_a_clock_only_newer_exchanges_count():
    sync = ClockSync()
    assert sync.bound_at(0.0) == float("inf")
    for turn in range(20):
        exchange(sync, turn / 4, 5.0, 0.01, 0.01)
    assert sync.bound_at(100.0) > sync.bound_at(5.0) + 94.0 * DRIFT, "while there is no exchange"
    exchange(sync, 6.0, 7.0, 0.01, 0.01)
    assert sync.offset_s == pytest.approx(7.0, abs=0.01)
