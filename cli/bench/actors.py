"""What is measured: the work of the peers' node, and the actors of the benchmark's systems."""

from __future__ import annotations

import math
import os
import time
from typing import Annotated

import msgspec
import numpy as np

from rampart.actors.bus.bounds import Count, Pid
from rampart.actors.bus.messages import Message
from rampart.actors.bus.topic import Qos, Topic
from rampart.actors.runtime.actor import Actor, Context, Header, every, on
from rampart.actors.runtime.parameters import TopicsHeard

POINTS = 360
"""Numbers in a scan, as of a small laser."""

INPUT_HZ, PING_HZ = 20.0, 50.0


def scan(number: int) -> bytes:
    """Return scan of that number: 64-bit floats, the first of which is the number."""
    return (number + np.arange(POINTS, dtype=np.float64)).tobytes()


def is_mean(first: float, mean: float) -> bool:
    """Whether a mean is that of the scan that begins with a number."""
    return math.isclose(mean, first + (POINTS - 1) / 2, rel_tol=1e-12)


class Scan(Message, frozen=True):
    """What the node works on: `scan`."""

    points: Annotated[bytes, msgspec.Meta(max_length=8 * POINTS)]


class Mean(Message, frozen=True):
    """What the node says: who it is, since when (monotonic, s), and the mean of a scan."""

    pid: Pid
    begun_s: float
    first: float
    mean: float


class Ping(Message, frozen=True):
    """A question, with how long the answer to the one before took (wall seconds; 0: none came)."""

    number: Count
    last_s: float


class Pong(Message, frozen=True):
    """The answer."""

    number: Count


class Tick(Message, frozen=True):
    """That a node of a large system is there."""

    number: Count


INPUT = Topic("bench/input", Scan, Qos.SENSOR, INPUT_HZ, "", "What the node works on.")
OUTPUT = Topic("bench/output", Mean, Qos.SENSOR, INPUT_HZ, "", "What the node says.",
               several=True)
PING = Topic("bench/ping", Ping, Qos.SENSOR, PING_HZ, "", "A question.")
PONG = Topic("bench/pong", Pong, Qos.SENSOR, PING_HZ, "", "Its answer.")
TICK = Topic("bench/tick/{name}", Tick, Qos.SENSOR, INPUT_HZ, "", "That a node is there.")


class Source(Actor):
    """Publishes the input, as the observer does for the peers."""

    outputs = (INPUT,)
    number = 0

    @every(1 / INPUT_HZ)
    def tell(self) -> None:
        """Publish the next scan."""
        self.number += 1
        self.publish(INPUT, Scan(scan(self.number)))


class Worker(Actor):
    """Does what `peer_node.py` does."""

    outputs = (OUTPUT,)

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._begun_s = time.monotonic()
        self._pid = os.getpid()

    @on(INPUT)
    def work(self, message: Scan, _header: Header) -> None:
        """Publish the mean of a scan."""
        points = np.frombuffer(message.points)
        self.publish(OUTPUT, Mean(
            self._pid, self._begun_s, float(points[0]), float(points.mean())))


class Asker(Actor):
    """Asks, and takes the time until the answer is heard."""

    outputs = (PING,)
    _number = 0
    _asked_s = _last_s = 0.0

    @every(1 / PING_HZ)
    def ask(self) -> None:
        """Ask the next question."""
        self._number += 1
        last_s, self._last_s = self._last_s, 0.0
        self._asked_s = time.monotonic()
        self.publish(PING, Ping(self._number, last_s))

    @on(PONG)
    def answer(self, message: Pong, _header: Header) -> None:
        """Note how long it took."""
        if message.number == self._number:
            self._last_s = time.monotonic() - self._asked_s


class Answerer(Actor):
    """Answers at once."""

    outputs = (PONG,)

    @on(PING)
    def ask(self, message: Ping, _header: Header) -> None:
        """Answer."""
        self.publish(PONG, Pong(message.number))


class Ticker(Actor):
    """A node of a large system: publishes at 20 Hz, and hears some others that do."""

    class Parameters(Actor.Parameters, frozen=True):
        """hears: ticks of others."""

        hears: TopicsHeard = ()

    parameters: Parameters
    outputs = (TICK,)
    _number = 0

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        for key in self.parameters.hears:
            self.hear_topic(key, self.heard)

    @every(1 / INPUT_HZ)
    def tick(self) -> None:
        """Say that it is there."""
        self._number += 1
        self.publish(TICK, Tick(self._number))

    def heard(self, _message: Tick, _header: Header) -> None:
        """Take the tick of another one."""
