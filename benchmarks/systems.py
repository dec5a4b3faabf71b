"""Systems and actors of `benchmarks.peers` and `benchmarks.size`, each as small as it can be.

They have no world and no modules, so no manager. The supervisor restarts a killed node, as the
peers restart theirs.
"""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Sequence
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

INPUT_HZ = 20.0

BESIDES = 7
"""Processes that are not nodes: root, run, supervisor, two routers, two of the pool."""

_HEAD = """name = "{name}"
title = "{title}"

[timing]
heartbeat_timeout_s = 0.5
command_timeout_s = 0.5
localization_timeout_s = 0.5
scan_timeout_s = 0.5
dead_man_timeout_s = 0.5
manager_timeout_s = 0.5
detection_silence_timeout_s = 0.9

# Nodes are killed on purpose, again and again.
[supervision]
intensity = 10000

[orders.safer]

[[event]]
name = "none"
"""


def scan(number: int) -> bytes:
    """Return the scan of that number: 64-bit floats, the first of which is the number."""
    return (number + np.arange(POINTS, dtype=np.float64)).tobytes()


def is_mean(first: float, mean: float) -> bool:
    """Whether a mean is that of the scan that begins with a number."""
    return math.isclose(mean, first + (POINTS - 1) / 2, rel_tol=1e-12)


class Scan(Message, frozen=True):
    """Input of the node: `scan`."""

    points: Annotated[bytes, msgspec.Meta(max_length=8 * POINTS)]


class Mean(Message, frozen=True):
    """Output of the node: its process, since when it runs (monotonic, s), the mean of a scan."""

    pid: Pid
    begun_s: float
    first: float
    mean: float


class Tick(Message, frozen=True):
    """A sign of life of a node of a large system."""

    number: Count


INPUT = Topic("bench/input", Scan, Qos.SENSOR, INPUT_HZ, "", "Input of the node.")
OUTPUT = Topic("bench/output", Mean, Qos.SENSOR, INPUT_HZ, "", "Output of the node.")
TICK = Topic("bench/tick/{name}", Tick, Qos.SENSOR, INPUT_HZ, "", "A sign of life.")


class Source(Actor):
    """Publishes the input."""

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
        self._begun_s, self._pid = time.monotonic(), os.getpid()

    @on(INPUT)
    def work(self, message: Scan, _header: Header) -> None:
        """Publish the mean of a scan."""
        points = np.frombuffer(message.points)
        self.publish(OUTPUT, Mean(
            self._pid, self._begun_s, float(points[0]), float(points.mean())))


class Ticker(Actor):
    """A node of a large system: publishes at 20 Hz, and subscribes to some others."""

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
        """Publish a tick."""
        self._number += 1
        self.publish(TICK, Tick(self._number))

    def heard(self, _message: Tick, _header: Header) -> None:
        """Take the tick of another node."""


def peers_system(command: Sequence[str]) -> str:
    """Return a system with the peers' node as an actor, and as a command."""
    return _HEAD.format(name="bench_peers", title="The peers' node") + f"""
[[node]]
name = "source"
actor = "benchmarks.systems:Source"
kind = "non-control"

[[node]]
name = "actor"
actor = "benchmarks.systems:Worker"
kind = "control"

[[node]]
name = "command"
command = {json.dumps(list(command))}
kind = "control"
env = {{ OPENBLAS_NUM_THREADS = "1", OMP_NUM_THREADS = "1" }}
"""


def sized_system(processes: int) -> str:
    """Return a system of so many processes; each node subscribes to the two before it."""
    names = [f"n{i}" for i in range(processes - BESIDES)]
    heard = [[f"bench/tick/{names[i - back]}" for back in (1, 2) if names[i - back] != name]
             for i, name in enumerate(names)]
    return _HEAD.format(name="bench_size", title=f"{processes} processes") + "".join(
        f'\n[[node]]\nname = "{name}"\nactor = "benchmarks.systems:Ticker"\n'
        f'kind = "control"\nparameters = {{ hears = {json.dumps(keys)} }}\n'
        for name, keys in zip(names, heard, strict=True))
