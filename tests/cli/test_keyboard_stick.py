"""Driving by keys: what a terminal sends, and the dead man that lives on its repetition."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rampart.cli.osmosis.joystick_verb import HOLD_S, KeyboardStick
from rampart.cli.terminal import KeyDecoder


def test_a_key_counts_for_a_moment_and_its_repetition_prolongs_it():
    stick = KeyboardStick(0.5)
    stick.press("up", 0.0)
    assert stick.stick(HOLD_S - 0.01).dead_man
    stick.press("up", HOLD_S - 0.01)
    assert stick.stick(2 * HOLD_S - 0.02).dead_man
    assert not stick.stick(2 * HOLD_S).dead_man
    for key in (" ", "k"):
        stick.press("up", 9.0)
        stick.press(key, 9.1)
        assert not stick.stick(9.1).dead_man, "letting go is immediate"


def test_keys_have_directions_and_the_speed_stays_between_a_tenth_and_all():
    stick = KeyboardStick(0.5)
    for key, forward, left in (("up", 1, 0), ("right", 0, -1), ("u", 1, 1), (".", -1, 1)):
        assert stick.press(key, 0.0)
        held = stick.stick(0.1)
        assert (held.forward, held.left) == (0.5 * forward, 0.5 * left)
    for key, speed in (("+", 1.0), ("-", 0.1)):
        for _ in range(50):
            stick.press(key, 0.0)
        assert stick.speed == speed


@given(st.lists(st.tuples(st.floats(0.0, 2.0), st.sampled_from(
    ["up", "down", *"uiojlm,.+-=kx "])), max_size=30))
def test_no_key_leaves_the_range_or_holds_longer_than_it_may(presses):
    stick, now_s, last_s = KeyboardStick(), 0.0, -1.0
    for pause_s, key in presses:
        now_s += pause_s
        if stick.press(key, now_s):
            last_s = now_s
        held = stick.stick(now_s)
        assert abs(held.forward) <= 1.0 >= abs(held.left)
        assert not held.dead_man or now_s - last_s < HOLD_S


@pytest.mark.parametrize(("data", "keys"), [
    (b"\x1b[A\x1b[B\x1b[C\x1b[D", ["up", "down", "right", "left"]),
    (b"\x1bOA", ["up"]),  # application mode
    (b"q", ["q"]),
    (b"\x1b[1;5A", ["up"]),  # with Ctrl
    (b"\x1b[15~x", ["x"]),  # F5
    (b"\xff\xfe", ["\ufffd", "\ufffd"]),
    (b"\x1b", []), (b"\x1b[", [])])
def test_a_terminals_bytes_are_keys(data, keys):
    decoder = KeyDecoder()
    assert decoder.feed(data) == keys
    assert decoder.feed(b"xq")[-1:] == ["q"]  # a sequence that has begun does not swallow it
