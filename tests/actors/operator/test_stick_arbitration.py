"""Who is followed when several hold a stick: timelines, and rules no order of events breaks."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rampart.actors.operator.stick_arbitration import FIRST_S, TIMEOUT_S, StickArbiter

HELD, FREE = True, False
LONG_AGO = -10.0


def play(page: str, device: str) -> str:
    """Return who is followed in each step of 100 ms.

    Args:
        page: one character a step: `#` held, `.` let go, blank silent.
        device: likewise.
    """
    arbiter = StickArbiter(LONG_AGO)
    seen = []
    for step, marks in enumerate(zip(page, device, strict=True)):
        now_s = step / 10
        arbiter.expire(now_s)
        followed = ""
        for name, mark in zip("pd", marks, strict=True):
            if mark == " ":
                continue
            ruling = arbiter.offer(name, HELD if mark == "#" else FREE, now_s, now_s)
            followed += name if ruling.follows else ""
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


def test_a_fresh_arbiter_follows_who_was_seen_to_rest_and_who_comes_later():
    arbiter = StickArbiter(started_s=10.0)
    assert "let go first" in arbiter.offer("page", HELD, 10.1, 10.1).told
    assert not arbiter.offer("page", HELD, 11.2, 11.2).follows
    arbiter.offer("device", FREE, 10.2, 10.2)
    assert arbiter.offer("device", HELD, 10.3, 10.3).since_s == 10.3
    assert arbiter.offer("device", HELD, 10.4, 10.4).since_s == 10.3
    arbiter.offer("device", FREE, 10.5, 10.5)
    late_s = 10.0 + FIRST_S
    assert arbiter.offer("tool", HELD, late_s, late_s).follows
    assert not StickArbiter().offer("page", HELD, 1e6, 1e6).follows  # a page reports its rest


@pytest.mark.parametrize("stamp_s", [-1.0, math.nan, -math.inf])
def test_a_position_that_is_old_on_arrival_moves_nothing(stamp_s):
    arbiter = StickArbiter(LONG_AGO)
    ruling = arbiter.offer("page", HELD, stamp_s, 0.0)
    assert (ruling.follows, ruling.told) == (False, "its position came too late")
    assert arbiter.holder == ""


def test_a_stamp_from_the_future_holds_no_longer_and_sources_are_not_kept_for_ever():
    arbiter = StickArbiter(LONG_AGO)
    assert arbiter.offer("page", HELD, math.inf, 0.0).follows
    assert arbiter.expire(TIMEOUT_S + 0.01).released
    for number in range(1000):
        arbiter.offer(f"tool {number}", HELD, number, number)
    assert len(arbiter._barred) <= 64


steps = st.lists(st.tuples(
    st.sampled_from("abc"), st.sampled_from(["held", "free", "late", "wait"]),
    st.floats(0.0, 0.5)), max_size=40)


@given(steps)
def test_no_order_of_events_breaks_the_rules(events):
    arbiter = StickArbiter(LONG_AGO)
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
                assert not ruling.follows
                assert ruling.released or owner != source
                owner = "" if owner == source else owner
            elif what == "late":
                assert not ruling.follows
            elif owner in {"", source} and source not in holding:
                assert ruling.follows
                owner = source
                last_s[source] = now_s
            else:
                assert not ruling.follows
                holding.add(source)
        assert arbiter.holder == owner
