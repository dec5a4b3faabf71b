"""A node whose loop turns at a given rate and hangs when it is told to, and a system round it."""

from __future__ import annotations

import ctypes
import time
from typing import Any

from rampart.actors.bus.messages import Message
from rampart.actors.bus.topic import Qos, Topic
from rampart.actors.runtime.actor import Actor, Header, every, on

HOW = ("sleep", "spin", "lock")
"""It waits for something; it does nothing but run; it waits with Python's lock held."""


class Count(Message, frozen=True):
    """How often it has turned."""

    number: int


class Hang(Message, frozen=True):
    """One of `HOW`."""

    how: str


COUNT_50 = Topic("count/fast", Count, Qos.SENSOR, 50.0, "", "It turns.")
COUNT_20 = Topic("count/slow", Count, Qos.SENSOR, 20.0, "", "It turns.")
HANG = Topic("hang/{name}", Hang, Qos.COMMAND, 0.0, "", "Node {name} is to hang.", outside=True)


def hang(how: str) -> None:
    """Never return."""
    match how:
        case "spin":
            while True:
                pass
        case "lock":
            ctypes.PyDLL(None).sleep(100_000)  # keeps the lock, unlike CDLL
        case _:
            time.sleep(100_000)


class _Loop(Actor):
    turns = 0

    @on(HANG)
    def told(self, message: Hang, _header: Header) -> None:
        """Hang."""
        hang(message.how)

    @classmethod
    def names(cls, topic: Topic[Any], name: str, parameters: Any) -> tuple[str, ...] | None:  # noqa: ARG003
        """Hear what it is told itself."""
        return (name,) if topic is HANG else None


class Fast(_Loop):
    """Turns 50 times a second."""

    outputs = (COUNT_50,)

    @every(0.02)
    def turn(self) -> None:
        """Show that it turns."""
        self.turns += 1
        self.publish(COUNT_50, Count(self.turns))


class Slow(_Loop):
    """Turns 20 times a second."""

    outputs = (COUNT_20,)

    @every(0.05)
    def turn(self) -> None:
        """Show that it turns."""
        self.turns += 1
        self.publish(COUNT_20, Count(self.turns))


SYSTEM = '''
name = "loops"
title = "Two loops that hang"

[timing]
heartbeat_period_s = 0.14
heartbeat_timeout_s = 0.44

[[node]]
name = "fast"
actor = "benchmarks.hanging_loop:Fast"
kind = "control"
respawn = "R"

[[node]]
name = "slow"
actor = "benchmarks.hanging_loop:Slow"
kind = "control"
respawn = "R"

[[node]]
name = "ftm_manager"
actor = "rampart.manager.actor:FtmManager"
kind = "manager"

[[detection]]
name = "D"
title = "Crash"
actor = "rampart.actors.detection.watchdog:Watchdog"

[detection.parameters]
watch = ["fast", "slow"]
timeout_s = "heartbeat_timeout_s"

[[recovery]]
name = "R"
title = "Respawn"
actor = "rampart.actors.recovery.respawn:Respawn"
kind = "masking"
claims = ["loops"]

[[mechanism]]
name = "M"
detect = "D"
recover = "R"
event = "crash"
against = { within_s = 5.0, hazard = "nothing" }

[[event]]
name = "crash"
title = "Crash"

[orders.safer]
'''
