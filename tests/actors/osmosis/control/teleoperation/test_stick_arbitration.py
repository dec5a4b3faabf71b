"""Who is followed when several hold a stick: timelines, and rules no order of events breaks."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rampart.actors.osmosis.control.teleoperation.stick_arbitration import TIMEOUT_S, StickArbiter
from rampart.actors.osmosis.messages import Joystick

HELD = Joystick(0.5, 0.0, True)
FREE = Joystick(0.0, 0.0, False)


def play(page: str, device: str) -> str:
    """Return who is followed in each step of 100 ms.

    Args:
        page: one character a step: `#` held, `.` let go, blank silent.
        device: likewise.
    """
    arbiter = StickArbiter()
    seen = []
    for step, marks in enumerate(zip(page, device, strict=True)):
        now_s = step / 10
        arbiter.expire(now_s)
        followed = ""
        for name, mark in zip("pd", marks, strict=True):
            if mark == " ":
                continue
            ruling = arbiter.offer(name, HELD if mark == "#" else FREE, now_s, now_s)
            followed += name if ruling.stick is not None else ""
        seen.append(followed or ("." if not arbiter.holder else "-"))
    return "".join(seen)


@pytest.mark.parametrize(("page", "device", "followed"), [
    # one alone is followed until it lets go
    (".##..",
     ".....",
     ".pp.."),
    # who was first keeps the stick; the other gets it by a press of its own, not by inheritance
    ("###....",
     ".####.#",
     "ppp...d"),
    # silence for more than 0.3 s is letting go, and who comes back has to let go first
    ("#    ##.#",
     ".........",
     "p---....p"),
    # one that was lost does not keep the other from driving
    ("#        ",
     ".....###.",
     "p---.ddd."),
    # a gap shorter than that is none
    ("# #  #",
     " #    ",
     "p-p--p"),
])
def test_who_is_followed(page, device, followed):
    assert play(page, device) == followed


def test_who_waits_is_told_once_and_again_only_after_having_let_go():
    arbiter = StickArbiter()
    arbiter.offer("page", HELD, 0.0, 0.0)
    told = [arbiter.offer("device", HELD, t, t).told for t in (0.05, 0.1)]
    assert told == ["not followed: page has the stick", ""]
    arbiter.offer("device", FREE, 0.15, 0.15)
    assert arbiter.offer("device", HELD, 0.2, 0.2).told == "not followed: page has the stick"


def test_who_was_lost_is_told_so_and_told_again_when_it_comes_back_holding():
    arbiter = StickArbiter()
    arbiter.offer("page", HELD, 0.0, 0.0)
    lost = arbiter.expire(1.0)
    assert (lost.released, lost.whom) == (True, "page")
    assert "not heard for 0.3 s" in lost.told
    assert arbiter.offer("page", HELD, 1.1, 1.1).told == "not followed: it has to let go first"


def test_a_release_stops_once():
    arbiter = StickArbiter()
    arbiter.offer("page", HELD, 0.0, 0.0)
    assert [arbiter.offer("page", FREE, t, t).released for t in (0.1, 0.2)] == [True, False]


@pytest.mark.parametrize("stamp_s", [-1.0, math.nan, -math.inf])
def test_a_position_that_is_old_on_arrival_moves_nothing(stamp_s):
    arbiter = StickArbiter()
    ruling = arbiter.offer("page", HELD, stamp_s, 0.0)
    assert (ruling.stick, ruling.told) == (None, "its position came too late")
    assert arbiter.holder == ""


def test_a_stamp_from_the_future_holds_no_longer_than_one_from_now():
    arbiter = StickArbiter()
    assert arbiter.offer("page", HELD, math.inf, 0.0).stick == HELD
    assert arbiter.expire(TIMEOUT_S + 0.01).released


@pytest.mark.parametrize("stick", [Joystick(math.nan, 0.0, True), Joystick(0.0, math.inf, True)])
def test_a_position_that_is_no_number_is_letting_go(stick):
    arbiter = StickArbiter()
    arbiter.offer("page", HELD, 0.0, 0.0)
    assert arbiter.offer("page", stick, 0.1, 0.1).released


def test_sources_that_come_and_go_for_ever_are_not_kept_for_ever():
    arbiter = StickArbiter()
    for number in range(1000):
        arbiter.offer(f"tool {number}", HELD, number, number)
    assert len(arbiter._barred) <= 64


steps = st.lists(st.tuples(
    st.sampled_from("abc"), st.sampled_from(["held", "free", "late", "wait"]),
    st.floats(0.0, 0.5)), max_size=40)


@given(steps)
def test_no_order_of_events_breaks_the_rules(events):
    arbiter = StickArbiter()
    now_s = 0.0
    holding: set[str] = set()  # dead man down since before its source could have got the stick
    last_s: dict[str, float] = {}
    owner = ""
    for source, what, pause_s in events:
        now_s += pause_s
        if owner and now_s - last_s[owner] > TIMEOUT_S:
            holding.add(owner)
            owner = ""
        if what == "wait":
            arbiter.expire(now_s)
        else:
            stamp_s = now_s - 1.0 if what == "late" else now_s
            ruling = arbiter.offer(source, FREE if what == "free" else HELD, stamp_s, now_s)
            if what == "free":
                holding.discard(source)
                assert ruling.stick is None
                assert ruling.released or owner != source
                owner = "" if owner == source else owner
            elif what == "late":
                assert ruling.stick is None
            elif owner in {"", source} and source not in holding:
                assert ruling.stick == HELD
                owner = source
                last_s[source] = now_s
            else:
                assert ruling.stick is None
                holding.add(source)
        assert arbiter.holder == owner
