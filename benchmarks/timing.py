"""How long do messages, deaths and starts take between real processes? For virtual time.

Runs the real system with a mission under way, listens to every heartbeat, and kills nodes and the
supervisor again and again. Prints `sim/virtual/timing.toml`: each distribution as 21 quantiles, in
milliseconds. `python -m benchmarks.timing > sim/virtual/timing.toml` renews it; two minutes.
"""

from __future__ import annotations

import argparse
import asyncio
import os
import random
import signal
import sys
import time
from typing import Any

from benchmarks.own_root import OwnLauncher
from rampart.actors.bus import topics as bus_topics
from rampart.actors.ftm import topics
from rampart.actors.ftm.messages import ProcessEvent, RespawnRequest
from rampart.actors.runtime.actor import Actor, Context, Header, on
from rampart.actors.runtime.clock import Clock
from rampart.actors.runtime.run_plan import OBSERVER, SUPERVISOR, RunPlan
from rampart.actors.supervision.process_title import find_processes

NODES = ("graph_planner", "osmosis_control", "localization", "teleoperation", "hmi",
         "safety_pilot", "ftm_manager", "DM2", "DM4", "RM2", "RM3")
QUANTILES = 21


class Ear(Actor):
    """Notes when things arrive."""

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self.messages: list[float] = []
        self.deaths: dict[tuple[str, int], float] = {}
        self.asked: dict[str, float] = {}
        self.words: dict[tuple[str, int], float] = {}

    @on(bus_topics.HEARTBEAT)
    def heartbeat(self, _message: Any, header: Header) -> None:
        """Note how long it took, and a new process's first word."""
        self.messages.append(self.clock.now() - header.stamp)
        self.words.setdefault((header.source, header.incarnation), header.stamp)

    @on(topics.RESPAWN)
    def respawn(self, request: RespawnRequest, header: Header) -> None:
        """Note when a recovery module asked for a process."""
        self.asked[request.node] = header.stamp

    @on(topics.PROCESS_EVENT)
    def process_event(self, message: ProcessEvent, _header: Header) -> None:
        """Note when a process was known to be gone."""
        if message.event == "crashed":
            self.deaths.setdefault((message.node, message.incarnation), time.monotonic())

    def start_s(self, node: str, incarnation: int, exited_s: float) -> float | None:
        """Return how long a successor took to its first word, from when it was to be started.

        That is when it was asked for, or when the supervisor saw the end of its predecessor.
        """
        said_s = [at_s for (name, number), at_s in self.words.items()
                  if name == node and number > incarnation]
        if not said_s:
            return None
        begun_s = max(exited_s, self.asked.get(node, exited_s))
        return max(0.0, min(said_s) - begun_s)  # the supervisor may see an end before this does


async def measure(port: int, kills: int) -> dict[str, list[float]]:
    """Run the system and return samples in seconds."""
    plan = RunPlan("bench", port, system_file="systems/paper.toml")
    launcher = OwnLauncher(plan, "timing")
    found: dict[str, list[float]] = {
        "message_ms": [], "death_ms": [], "exit_ms": [], "start_ms": [], "supervisor_back_ms": []}
    back: list[float] = []
    try:
        await launcher.load()
        await launcher.start()
        launcher.on_restart = lambda _name: back.append(time.monotonic())
        bus = launcher.observers_bus()
        clock = Clock(launcher.plan.origin_s)
        ear = Ear(Context(OBSERVER, 1, clock, bus), launcher)
        task = asyncio.create_task(ear.run())
        await asyncio.sleep(6.0)
        quiet = len(ear.messages)
        await asyncio.sleep(20.0)
        found["message_ms"] = ear.messages[quiet:]
        for _ in range(kills):
            for node in NODES:
                killed_s, exited_s, incarnation = await _kill(port, node)
                found["exit_ms"].append(exited_s - killed_s)
                await asyncio.sleep(0.35 + random.uniform(0, 0.05))
                if (node, incarnation) in ear.deaths:
                    found["death_ms"].append(ear.deaths[node, incarnation] - killed_s)
                start_s = ear.start_s(node, incarnation, exited_s - launcher.plan.origin_s)
                if start_s is not None:
                    found["start_ms"].append(start_s)
        for _ in range(2 * kills):
            back.clear()
            killed_s, _, _ = await _kill(port, SUPERVISOR)
            while not back:  # noqa: ASYNC110 a callback of the launcher's
                await asyncio.sleep(0.001)
            found["supervisor_back_ms"].append(back[0] - killed_s)
            await asyncio.sleep(1.0)
        ear.stop()
        await task
    finally:
        await launcher.end()
    return found


async def _kill(port: int, node: str) -> tuple[float, float, int]:
    """Kill a node; return when, when its pidfd told, and its incarnation."""
    victim = max((p for p in find_processes(port) if node in p.names),
                 key=lambda p: p.incarnation)
    loop = asyncio.get_running_loop()
    ended = loop.create_future()
    pidfd = os.pidfd_open(victim.pid)
    loop.add_reader(pidfd, lambda: ended.done() or ended.set_result(time.monotonic()))
    killed_s = time.monotonic()
    os.kill(victim.pid, signal.SIGKILL)
    exited_s = await ended
    loop.remove_reader(pidfd)
    os.close(pidfd)
    return killed_s, exited_s, victim.incarnation


def quantiles_ms(samples: list[float]) -> list[float]:
    """Return evenly spaced quantiles from minimum to maximum, milliseconds."""
    ordered = sorted(samples)
    last = len(ordered) - 1
    return [round(ordered[round(i * last / (QUANTILES - 1))] * 1e3, 3) for i in range(QUANTILES)]


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--port", type=int, default=21_000)
    parser.add_argument("--kills", type=int, default=10, help="of each node")
    options = parser.parse_args()
    found = asyncio.run(measure(options.port, options.kills))
    print("# Measured on real processes by `python -m benchmarks.timing`; milliseconds, evenly\n"
          "# spaced quantiles from minimum to maximum. See sim/virtual/network.py for what each "
          "one is.")
    for name, samples in found.items():
        print(f"\n# {len(samples)} samples\n{name} = {quantiles_ms(samples)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
