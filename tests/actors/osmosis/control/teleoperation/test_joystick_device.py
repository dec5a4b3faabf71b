"""The joystick's decoder on records, its reader on a FIFO and a pseudo-terminal."""

from __future__ import annotations

import asyncio
import os
import pty
import re
import tty

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis.control.teleoperation.joystick_device import (
    AXIS,
    BUTTON,
    EVENT,
    INITIAL,
    ForeignDeviceError,
    JoystickDevice,
    StickDecoder,
    StickMapping,
    device_path,
)
from rampart.actors.osmosis.control.teleoperation.teleoperation import Teleoperation
from rampart.actors.runtime.parameters import read_parameters

PLAIN = StickMapping(dead_zone=0.0)
RELEASED = m.Joystick(0.0, 0.0, False)


def record(kind: int, number: int, value: int) -> bytes:
    return EVENT.pack(7, value, kind, number)


PRESS, LET_GO = record(BUTTON, 4, 1), record(BUTTON, 4, 0)


def position(*records: bytes, mapping: StickMapping = PLAIN) -> m.Joystick:
    decoder = StickDecoder(mapping)
    for one in records:
        decoder.feed(one)
    return decoder.stick


@pytest.mark.parametrize(("records", "expected"), [
    ((PRESS, record(AXIS, 1, -32767), record(AXIS, 0, -32767)), m.Joystick(1.0, 1.0, True)),
    ((PRESS, record(AXIS, 1, 32767), record(AXIS, 0, 32767)), m.Joystick(-1.0, -1.0, True)),
    ((record(AXIS, 1, -32768),), m.Joystick(1.0, 0.0, False)),
    ((record(AXIS, 3, 9000), record(BUTTON, 0, 1)), RELEASED)])
def test_a_stick_pushed_forward_and_left_is_forward_and_left(records, expected):
    assert position(*records) == expected


def test_within_the_dead_zone_nothing_moves_and_beyond_it_begins_at_zero():
    mapping = StickMapping(dead_zone=0.5)

    def forward(value: int) -> float:
        return position(record(AXIS, 1, value), mapping=mapping).forward

    assert forward(-16000) == 0.0
    assert 0.0 < forward(-16500) < 0.01
    assert forward(-32767) == 1.0


def test_only_a_press_counts_and_neither_the_first_state_nor_one_after_an_overflow():
    down, up = record(BUTTON | INITIAL, 4, 1), record(BUTTON | INITIAL, 4, 0)
    assert not position(down).dead_man
    assert position(down, LET_GO, PRESS).dead_man
    assert position(PRESS, down).dead_man
    assert not position(PRESS, up).dead_man


@pytest.mark.parametrize("kind", [0x00, 0x03, 0x80, 0xff])
def test_a_device_that_is_no_joystick_is_refused(kind):
    with pytest.raises(ForeignDeviceError, match="expected 0x01"):
        position(PRESS, record(kind, 4, 1))


@given(st.lists(st.tuples(
    st.sampled_from([BUTTON, AXIS, BUTTON | INITIAL, AXIS | INITIAL]), st.integers(0, 255),
    st.integers(-32768, 32767)), max_size=40),
    st.floats(0.0, 0.99), st.integers(1, 50))
def test_no_stream_of_records_leaves_the_range(records, zone, piece):
    decoder = StickDecoder(StickMapping(dead_zone=zone))
    stream = b"".join(record(*one) for one in records)
    for start in range(0, len(stream), piece):
        decoder.feed(stream[start:start + piece])
        assert -1.0 <= decoder.stick.forward <= 1.0
        assert -1.0 <= decoder.stick.left <= 1.0
    released = [value for kind, number, value in records if number == 4 and kind & BUTTON]
    assert not (decoder.stick.dead_man and (not released or released[-1] == 0))


@pytest.mark.parametrize(("parameters", "words"), [
    ({"dead_zone": 1.0}, "dead_zone = 1.0: expected a number, 0 or more, below 1"),
    ({"forward_sign": 2}, "forward_sign = 2: expected -1 or 1"),
    ({"left_axis": 1}, "left_axis = 1: expected another axis than forward_axis")])
def test_a_mapping_without_sense_is_refused_by_name_and_value(parameters, words):
    with pytest.raises(ValueError, match=re.escape(words)):
        read_parameters(Teleoperation.Parameters, parameters, "spec.toml", "parameters")


def test_the_first_joystick_is_the_one_with_the_lowest_number(tmp_path):
    assert device_path("auto", tmp_path) == ""
    for name in ("js10", "js9", "event0", "jsx"):
        (tmp_path / name).touch()
    assert device_path("auto", tmp_path) == str(tmp_path / "js9")
    assert device_path("/dev/input/js3", tmp_path) == "/dev/input/js3"


class Hand:
    """A device and its reports, with a way to wait for them."""

    def __init__(self, path: object) -> None:
        self.gone: list[str] = []
        self._changed = asyncio.Event()
        self.device = JoystickDevice(str(path), PLAIN, self._changed.set, self._vanished)

    def _vanished(self, why: str) -> None:
        self.gone.append(why)
        self._changed.set()

    async def until(self, condition):
        async with asyncio.timeout(10):
            while not condition():
                self._changed.clear()
                await self._changed.wait()


async def test_a_fifo_or_a_device_that_goes_away_lets_the_stick_go(tmp_path):
    path = tmp_path / "stick"
    os.mkfifo(path)
    hand = Hand(path)
    assert hand.device.open() == ""
    writer = os.open(path, os.O_WRONLY)
    os.write(writer, PRESS + record(AXIS, 1, -32767))
    await hand.until(lambda: hand.device.stick == m.Joystick(1.0, 0.0, True))
    os.close(writer)
    await hand.until(lambda: hand.gone == ["ended"])
    assert hand.device.stick == RELEASED
    master, slave = pty.openpty()
    tty.setraw(slave)
    hand = Hand(os.ttyname(slave))
    assert hand.device.open() == ""
    os.write(master, PRESS)
    await hand.until(lambda: hand.device.stick.dead_man)
    os.close(slave)
    os.close(master)
    await hand.until(lambda: len(hand.gone) == 1)
    assert hand.device.stick == RELEASED


async def test_what_cannot_be_a_joystick_is_named(tmp_path):
    (tmp_path / "file").touch()
    for path, why in ((tmp_path / "file", "neither a device nor a FIFO"),
                      (tmp_path / "none", "No such file"), ("/dev/zero", "not a joystick"),
                      ("a\0b", "null")):
        assert why in Hand(path).device.open()
