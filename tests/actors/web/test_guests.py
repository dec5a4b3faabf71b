"""Who has to go when too many are connected, and when."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rampart.actors.web.guests import (
    BYTES_AT_ONCE,
    BYTES_PER_S,
    PATIENCE_S,
    REQUESTS_AT_ONCE,
    ROOM,
    WAITING_ROOM,
    Bucket,
    Guests,
)


class Hall:
    """Guests that are numbered as they come, one each second."""

    def __init__(self) -> None:
        self.guests: Guests[int] = Guests()
        self.there: list[int] = []
        self.gone: list[int] = []
        self.count = 0

    def come(self, source: str, count: int = 1, *, known: bool = False):
        for _ in range(count):
            self.count += 1
            guest, go = self.guests.came(self.count, source, known=known, now_s=float(self.count))
            self.there = [n for n in (*self.there, self.count) if n not in go]
            self.gone += go
        return guest


@pytest.fixture
def hall() -> Hall:
    return Hall()


def test_of_one_source_the_one_that_has_waited_longest_goes(hall):
    hall.come("a", WAITING_ROOM + 3)
    assert hall.gone == [1, 2, 3]
    assert len(hall.guests) == WAITING_ROOM


def test_a_flood_from_one_source_sends_nobody_else_away(hall):
    hall.come("operator", 2)
    hall.come("flood", 10 * ROOM)
    assert {1, 2} <= set(hall.there)


def test_who_is_alone_gets_in_however_many_there_are_from_however_many_sources(hall):
    for source in range(5 * ROOM):
        hall.come(f"stranger {source}")
    hall.come("operator")
    assert hall.count in hall.there
    assert len(hall.guests) == ROOM


def test_a_source_that_has_more_loses_one_before_a_source_that_has_less(hall):
    hall.come("few", 2)
    for source in ("many", "more"):
        hall.come(source, WAITING_ROOM)
    hall.come("others", ROOM - 2 - 2 * WAITING_ROOM)
    assert hall.gone == []
    hall.come("newcomer")
    assert hall.gone == [3]


def test_who_has_shown_a_token_goes_last(hall):
    hall.come("home", 3, known=True)
    hall.come("home", WAITING_ROOM)
    assert hall.gone == [4, 5, 6]


def test_who_is_served_does_not_go_and_does_not_count_as_waiting(hall):
    for _ in range(16):
        hall.come("home", known=True).served = 1
    hall.come("home", WAITING_ROOM + 1)
    assert hall.gone == [17]


def test_where_all_are_served_the_newcomer_has_to_go(hall):
    for _ in range(ROOM):
        hall.come("home", known=True).served = 1
    hall.come("other")
    assert hall.gone == [ROOM + 1]


def test_who_waits_too_long_goes_and_who_is_served_does_not(hall):
    hall.come("a").served = 1
    hall.come("b")
    assert hall.guests.overdue(2.0 + PATIENCE_S) == []
    assert hall.guests.overdue(2.1 + PATIENCE_S) == [2]
    assert len(hall.guests) == 1


def test_who_was_answered_has_all_patience_again(hall):
    hall.come("a").since_s = 4.0
    assert hall.guests.overdue(3.9 + PATIENCE_S) == []


def test_one_that_left_takes_no_room_and_may_leave_twice(hall):
    hall.come("a")
    hall.guests.left(1)
    hall.guests.left(1)
    assert len(hall.guests) == 0


def test_who_sends_as_much_as_is_allowed_may_stay_and_who_sends_more_may_not(hall):
    guest = hall.come("a")
    assert guest.sends(BYTES_AT_ONCE, 1.0)
    assert all(guest.sends(BYTES_PER_S, 1.0 + second) for second in range(1, 100))
    assert not guest.sends(BYTES_PER_S, 100.5)


def test_a_source_without_a_token_may_ask_for_so_much_with_all_its_connections_together(hall):
    guests = [hall.come("a"), hall.come("a")]
    assert all(guests[i % 2].answered(2.0) for i in range(REQUESTS_AT_ONCE))
    assert not guests[0].answered(2.0)
    assert hall.come("b").answered(3.0)
    assert hall.come("a", known=True).answered(2.0)


def test_a_bucket_says_how_long_to_wait_and_fills_again():
    bucket = Bucket(2, 10, 0.0)
    assert [bucket.take(1, 0.0) for _ in range(4)] == [0, 0, pytest.approx(0.1), pytest.approx(0.2)]
    assert bucket.take(1, 0.5) == 0
    assert [bucket.take(1, 100.0) for _ in range(3)] == [0, 0, pytest.approx(0.1)]


def test_nothing_is_kept_of_a_source_that_has_left(hall):
    hall.come("a", 2)
    for number in (1, 2):
        assert "a" in hall.guests._requests
        hall.guests.left(number)
    assert hall.guests._requests == {}


@given(st.lists(st.tuples(st.sampled_from("abcdef"), st.booleans(), st.booleans())))
def test_there_are_never_more_than_there_is_room_for(coming):
    hall = Hall()
    for source, known, served in coming * 5:
        hall.come(source, known=known).served = served
        assert len(hall.guests) == len(hall.there) <= ROOM
        waiting = [g.source for g in hall.guests._guests.values() if not g.served]
        assert all(waiting.count(s) <= WAITING_ROOM for s in set(waiting))
