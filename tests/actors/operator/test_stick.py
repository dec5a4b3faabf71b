"""Who has the stick: the first that holds it, until it lets go or what it says is old."""

from __future__ import annotations

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rampart.actors.operator.requests import StickRequest
from rampart.actors.operator.stick import SILENCE_S, TICKET_S, Grip, StickDesk

BUSY = settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])
PERIOD_S = 0.05


def hold(desk: StickDesk, page: int, now_s: float, ticket: int = 0, at=(0.5, 0.0)):
    return desk.move(page, StickRequest("Drive", True, ticket, *at), now_s)


def let_go(desk: StickDesk, page: int, now_s: float):
    return desk.move(page, StickRequest("Drive", False), now_s)


def drive(desk: StickDesk, page: int, begin_s: float, end_s: float) -> int:
    """Have a page hold the stick for a while and return its newest ticket."""
    answer = hold(desk, page, begin_s)
    now_s = begin_s
    while now_s < end_s:
        now_s = min(now_s + PERIOD_S, end_s)
        answer = hold(desk, page, now_s, answer.ticket)
    assert answer.grip is Grip.DRIVES
    return answer.ticket


def test_the_first_message_gets_a_ticket_and_moves_nothing():
    desk = StickDesk()
    first = hold(desk, 1, 10.0)
    assert (first.grip, desk.position(10.0)) == (Grip.WAITS, None)
    assert hold(desk, 1, 10.01, first.ticket).grip is Grip.DRIVES
    assert desk.position(10.01) == (0.5, 0.0)


def test_letting_go_stops_at_once_and_frees_the_stick():
    desk = StickDesk()
    drive(desk, 1, 0.0, 1.0)
    assert let_go(desk, 1, 1.05).grip is Grip.FREE
    assert (desk.position(1.05), desk.holder) == (None, None)
    drive(desk, 2, 1.1, 2.0)
    assert desk.holder == 2


def test_a_page_that_falls_silent_has_let_go_and_has_to_do_so_before_it_drives_again():
    desk = StickDesk()
    ticket = drive(desk, 1, 0.0, 1.0)
    assert desk.position(1.0 + SILENCE_S - 0.01) is not None
    assert desk.position(1.0 + SILENCE_S + 0.01) is None
    assert desk.expire(1.0 + SILENCE_S + 0.01) == 1
    late = hold(desk, 1, 1.4, ticket)
    assert (late.grip, late.text) == (Grip.LAPSED, "let go of the stick and press again")
    assert hold(desk, 1, 1.45, late.ticket).grip is Grip.LAPSED
    assert let_go(desk, 1, 1.5).grip is Grip.FREE
    drive(desk, 1, 1.5, 2.0)


def test_the_other_page_is_told_who_has_the_stick_and_does_not_disturb():
    desk = StickDesk()
    drive(desk, 1, 0.0, 1.0)
    other = hold(desk, 2, 1.0)
    assert (other.grip, other.text) == (Grip.TAKEN, "page 1 has the stick")
    assert let_go(desk, 2, 1.01).grip is Grip.FREE
    assert (desk.holder, desk.position(1.02)) == (1, (0.5, 0.0))


def test_the_other_page_does_not_drive_on_because_the_first_lets_go():
    desk = StickDesk()
    drive(desk, 1, 0.0, 1.0)
    ticket = hold(desk, 2, 1.0).ticket
    let_go(desk, 1, 1.05)
    assert hold(desk, 2, 1.1, ticket).grip is Grip.LAPSED
    assert let_go(desk, 2, 1.15).grip is Grip.FREE
    drive(desk, 2, 1.2, 2.0)


def test_what_a_stalled_network_delivers_late_does_not_move_the_robot():
    desk = StickDesk()
    ticket = drive(desk, 1, 0.0, 1.0)
    desk.expire(3.0)
    burst = [hold(desk, 1, 3.0, ticket) for _ in range(20)]
    burst += [let_go(desk, 1, 3.0)] + [hold(desk, 1, 3.0, ticket) for _ in range(20)]
    assert {answer.grip for answer in burst} == {Grip.LAPSED, Grip.FREE, Grip.WAITS}
    assert desk.position(3.0) is None


def test_a_connection_that_is_too_slow_loses_the_stick_and_is_told():
    desk = StickDesk()
    ticket = drive(desk, 1, 0.0, 1.0)
    now_s = 1.0
    while (answer := hold(desk, 1, now_s, ticket)).grip is Grip.DRIVES:  # the same old ticket
        now_s += PERIOD_S
    assert answer.grip is Grip.LATE
    assert "slower than 0.3 s" in answer.text
    assert now_s == pytest.approx(1.0 + TICKET_S, abs=2 * PERIOD_S)
    assert hold(desk, 1, now_s, answer.ticket).grip is Grip.LAPSED


def test_a_ticket_of_another_page_is_worth_nothing():
    desk = StickDesk()
    mine = hold(desk, 1, 0.0).ticket
    assert hold(desk, 2, 0.01, mine).grip is Grip.WAITS


@pytest.mark.parametrize(("forward", "left", "named"), [
    (1.5, 0.0, "forward = 1.5"), (0.0, -1.01, "left = -1.01"), (1e308, 0.0, "forward = 1e+308"),
    (float("nan"), 0.0, "forward = nan"), (0.0, float("inf"), "left = inf")])
def test_a_position_out_of_bounds_is_refused_and_counts_as_let_go(forward, left, named):
    desk = StickDesk()
    ticket = drive(desk, 1, 0.0, 1.0)
    answer = hold(desk, 1, 1.01, ticket, (forward, left))
    assert answer.grip is Grip.REFUSED
    assert named in answer.text
    assert desk.position(1.01) is None
    assert hold(desk, 1, 1.02, answer.ticket).grip is Grip.LAPSED


def test_a_page_that_closes_has_let_go_and_only_if_it_had_the_stick():
    desk = StickDesk()
    drive(desk, 1, 0.0, 1.0)
    assert desk.gone(2) is False
    assert desk.gone(1) is True
    assert desk.position(1.0) is None


MESSAGES = st.lists(st.tuples(
    st.integers(1, 3), st.booleans(), st.sampled_from(["newest", "old", "another's", "none"]),
    st.floats(-1.5, 1.5), st.floats(0, 0.6)), max_size=40)


@BUSY
@given(MESSAGES)
def test_whatever_pages_send_one_drives_at_most_and_only_with_fresh_news(messages):
    """The robot moves only by a held position within bounds whose ticket was fresh, of a page that
    let go after it last lost the stick."""
    desk, now_s = StickDesk(), 0.0
    given_at: dict[int, list[tuple[int, float]]] = {1: [], 2: [], 3: []}
    must_let_go: set[int] = set()
    for page, held, which, forward, pause_s in messages:
        now_s += pause_s
        before = desk.holder
        lapsed = desk.expire(now_s)
        if lapsed is not None:
            assert lapsed == before
            must_let_go.add(lapsed)
        mine = given_at[page]
        others = [t for p, tickets in given_at.items() if p != page for t in tickets]
        choice = {"newest": mine[-1:], "old": mine[:1], "another's": others[-1:], "none": []}
        number, at_s = (choice[which] or [(0, -9.0)])[0]
        holder = desk.holder
        answer = desk.move(page, StickRequest("Drive", held, number, forward, 0.0), now_s)
        if not held:
            must_let_go.discard(page)
        if answer.grip in (Grip.LATE, Grip.REFUSED, Grip.TAKEN):
            must_let_go.add(page)
        if answer.grip is Grip.DRIVES:
            assert held
            assert abs(forward) <= 1.0 + 1e-6
            assert which in ("newest", "old")
            assert now_s - at_s <= TICKET_S
            assert page not in must_let_go
            assert holder in (None, page)
            assert desk.position(now_s) == (pytest.approx(forward, abs=1e-5), 0.0)
        elif holder in (None, page):
            assert desk.position(now_s) is None
        else:
            assert desk.holder == holder
        assert desk.position(now_s + SILENCE_S + 1e-6) is None
        mine.append((answer.ticket, now_s))
