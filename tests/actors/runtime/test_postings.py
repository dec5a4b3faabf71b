"""A repeated state is posted: it is sent when it changes, and once a second."""

import asyncio
from contextlib import asynccontextmanager
from typing import ClassVar

import pytest

from rampart.actors.bus.messages import Message
from rampart.actors.bus.topic import Qos, Topic
from rampart.actors.bus.topics import HEARTBEAT
from rampart.actors.runtime.actor import Actor, every, on
from rampart.testing.virtual import VirtualSystem
from tests.virtual_time import within

PERIOD_S = 0.1
"""Default period of heartbeats."""


class Level(Message, frozen=True):
    """A level."""

    value: float


LEVEL = Topic("level", Level, Qos.STATE, 10, "", "A level.", resend_s=1)


class Gauge(Actor):
    """Publishes a level ten times a second."""

    outputs = (LEVEL,)
    value: ClassVar[float] = 1.0

    @every(0.1)
    def say(self):
        self.publish(LEVEL, Level(type(self).value))


class Reader(Actor):
    """Keeps the levels and heartbeats of the gauge, with their arrival times."""

    def on_start(self):
        self.levels, self.ages_s, self.beats = [], [], 0

    @classmethod
    def names(cls, topic, name, parameters):
        return ("gauge",)

    @on(LEVEL)
    def level(self, message, header):
        self.levels.append((self.clock.now(), message.value, header.stamp))
        self.ages_s.append(self.came_s(header) - header.stamp)

    @on(HEARTBEAT)
    def beat(self, _message, _header):
        self.beats += 1


@asynccontextmanager
async def postings():
    Gauge.value = 1.0
    async with VirtualSystem() as system:
        sent = system.overhear("gauge")
        reader = system.start("reader", Reader)
        system.start("gauge", Gauge)
        await asyncio.sleep(0.5)
        yield system, reader, sent


def count(sent, key):
    return sum(k == key for k, _ in sent)


@within(postings)
async def test_what_says_the_same_is_sent_once_a_second_and_read_with_each_heartbeat(given):
    _system, reader, sent = given
    sent.clear()
    reader.levels.clear()
    reader.beats = 0
    await asyncio.sleep(10.0)
    assert count(sent, "level") == pytest.approx(10, abs=1)
    assert count(sent, "heartbeat/gauge") == pytest.approx(2, abs=1)
    assert len(reader.levels) == pytest.approx(100, abs=2)
    assert reader.beats == pytest.approx(100, abs=2)
    assert all(now_s - stamp_s <= 2 * PERIOD_S for now_s, _, stamp_s in reader.levels)
    assert max(reader.ages_s) == pytest.approx(0.0)  # it came when it was posted
    stamps = [stamp_s for _, _, stamp_s in reader.levels]
    assert stamps == sorted(set(stamps))  # each was taken once, by whatever way it came


@within(postings)
async def test_a_change_is_sent_at_once(given):
    _system, reader, sent = given
    sent.clear()
    reader.levels.clear()
    Gauge.value = 2.0
    await asyncio.sleep(0.25)
    assert count(sent, "level") == 1
    changed = next((now_s, stamp_s) for now_s, value, stamp_s in reader.levels if value == 2.0)
    assert changed[0] == pytest.approx(changed[1])


@within(postings)
async def test_one_that_hangs_posts_no_more_and_one_that_goes_on_does_again(given):
    system, reader, _sent = given
    gauge = system.actors["gauge"]
    gauge.hold(True)
    await asyncio.sleep(2 * PERIOD_S)
    reader.beats = 0
    await asyncio.sleep(2.0)
    assert reader.beats == 0
    gauge.hold(False)
    await asyncio.sleep(2 * PERIOD_S)
    assert reader.beats >= 1
