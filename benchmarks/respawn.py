"""How long from SIGKILL of a node to detection, decision, and its replacement's first output?

Runs the real system (all processes, real Zenoh, mission under way) and kills nodes in turn.
Times are taken in this process: from the `kill` call to the arrival of the detection module's
report, of the manager's decision, and of the first message on the node's own output topic that
a new incarnation has sent. `make bench-respawn` runs it.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import random
import signal
import statistics
import sys
import time
from collections import deque
from typing import Any

from rampart.actors.bus import topics as bus_topics
from rampart.actors.bus.topic import Topic
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.ftm.messages import DecisionRecord, DetectionReport, DetectionState, NodeTable
from rampart.actors.osmosis import topics
from rampart.actors.run.run_plan import OBSERVER, RunPlan
from rampart.actors.runtime.actor import Actor, Context, Header, on
from rampart.actors.runtime.clock import Clock
from rampart.actors.supervision.launcher import Launcher
from rampart.actors.supervision.process_title import find_processes

OUTPUT: dict[str, Topic[Any]] = {
    "graph_planner": topics.ROUTE,
    "osmosis_control": topics.COMMAND,
    "localization": topics.POSE,
    "teleoperation": bus_topics.HEARTBEAT,
    "hmi": bus_topics.HEARTBEAT,
    "safety_pilot": topics.BASE_COMMAND,
    "ftm_manager": ftm_topics.MANAGER_STATUS,
    "DM2": ftm_topics.DETECTION,
    "RM2": ftm_topics.RECOVERY,
    "mission_manager": topics.MISSION_STATUS,  # last: without checkpoints it loses the mission
}
"""Nodes to kill and the topic whose first message shows that the replacement works."""


class Stopwatch(Actor):
    """Notes when things arrive; times are wall seconds of this process."""

    def __init__(self, context: Context, launcher: Launcher) -> None:
        super().__init__(context)
        self._launcher = launcher
        self.newest: dict[str, int] = {}
        self.first: dict[tuple[str, int, str], float] = {}
        self.story: deque[str] = deque(maxlen=40)
        self.detected_s: float | None = None
        self.decided_s: float | None = None

    @on(ftm_topics.NODES)
    def nodes(self, table: NodeTable, _header: Header) -> None:
        """Keep the launcher's guard informed."""
        self._launcher.supervisor_heard(table)

    @on(ftm_topics.DETECTION)
    def detection(self, report: DetectionReport, header: Header) -> None:
        """Note the first active report."""
        self._note(header, ftm_topics.DETECTION)
        if report.state is DetectionState.ACTIVE:
            self.story.append(f"{header.stamp:.2f} {header.source} {report}")
        if report.state is DetectionState.ACTIVE and self.detected_s is None:
            self.detected_s = time.monotonic()

    @on(ftm_topics.DECISION)
    def decision(self, record: DecisionRecord, _header: Header) -> None:
        """Note the first decision with a recovery."""
        self.story.append(str(record))
        if record.recoveries and self.decided_s is None:
            self.decided_s = time.monotonic()

    @on(ftm_topics.PROCESS_EVENT)
    @on(bus_topics.DIAGNOSTIC)
    def event(self, message: Any, header: Header) -> None:
        """Keep the story, for when a node does not come back."""
        self.story.append(f"{header.stamp:.2f} {header.source} {message}")

    @on(topics.MISSION_STATUS)
    def mission(self, _message: Any, header: Header) -> None:
        """Note the first message of each incarnation."""
        self._note(header, topics.MISSION_STATUS)

    @on(topics.ROUTE)
    def route(self, _message: Any, header: Header) -> None:
        """Note the first message of each incarnation."""
        self._note(header, topics.ROUTE)

    @on(topics.COMMAND)
    def command(self, _message: Any, header: Header) -> None:
        """Note the first message of each incarnation."""
        self._note(header, topics.COMMAND)

    @on(topics.POSE)
    def pose(self, _message: Any, header: Header) -> None:
        """Note the first message of each incarnation."""
        self._note(header, topics.POSE)

    @on(topics.BASE_COMMAND)
    def base_command(self, _message: Any, header: Header) -> None:
        """Note the first message of each incarnation."""
        self._note(header, topics.BASE_COMMAND)

    @on(ftm_topics.MANAGER_STATUS)
    def manager(self, _message: Any, header: Header) -> None:
        """Note the first message of each incarnation."""
        self._note(header, ftm_topics.MANAGER_STATUS)

    @on(ftm_topics.RECOVERY)
    def recovery(self, _message: Any, header: Header) -> None:
        """Note the first message of each incarnation."""
        self._note(header, ftm_topics.RECOVERY)

    @on(bus_topics.HEARTBEAT)
    def heartbeat(self, _message: Any, header: Header) -> None:
        """Note the first message of each incarnation."""
        self._note(header, bus_topics.HEARTBEAT)

    def _note(self, header: Header, topic: Topic[Any]) -> None:
        self.newest[header.source] = max(self.newest.get(header.source, 0), header.incarnation)
        self.first.setdefault((header.source, header.incarnation, topic.key), time.monotonic())


async def measure(options: argparse.Namespace) -> list[dict[str, Any]]:
    """Run the system, kill the nodes, and return one row of milliseconds per node."""
    plan = RunPlan("bench", options.port, system_file=options.system)
    launcher = Launcher(plan, "benchmark")
    launcher.begin()
    rows = []
    try:
        await launcher.load()
        await launcher.start()
        bus = launcher.observers_bus()
        clock = Clock(launcher.plan.origin_s)
        watch = Stopwatch(Context(OBSERVER, 1, clock, bus), launcher)
        task = asyncio.create_task(watch.run())
        await asyncio.sleep(4.0)
        for node in options.node or OUTPUT:
            samples = [await _kill(watch, options.port, node) for _ in range(options.kills)]
            row: dict[str, Any] = {"node": node, "kills": options.kills}
            for i, figure in enumerate(("detected", "decided", "output")):
                values = sorted(s[i] * 1e3 for s in samples if s[i] is not None)  # type: ignore[operator]
                if values:
                    row[figure] = {
                        "median_ms": round(statistics.median(values), 1),
                        "min_ms": round(values[0], 1), "max_ms": round(values[-1], 1),
                        "n": len(values)}
            rows.append(row)
            if not options.json:
                print(_text(row), flush=True)
        watch.stop()
        await task
    finally:
        await launcher.end()
    return rows


async def _kill(
    watch: Stopwatch, port: int, node: str
) -> tuple[float | None, float | None, float | None]:
    found = [p for p in find_processes(port) if node in p.names]
    if not found:
        raise SystemExit("\n".join([*watch.story, f"{node} did not come back"]))
    victim = max(found, key=lambda p: p.incarnation)
    old = victim.incarnation
    watch.detected_s = watch.decided_s = None
    start = time.monotonic()
    os.kill(victim.pid, signal.SIGKILL)
    key = (node, old + 1, OUTPUT[node].key)
    while key not in watch.first and time.monotonic() - start < 5:  # noqa: ASYNC110 polled
        await asyncio.sleep(0.001)
    # Let detection modules go idle again, and lose step with the 20 Hz of sensors and commands.
    await asyncio.sleep(1.2 + random.uniform(0.0, 0.05))

    def since(at: float | None) -> float | None:
        return None if at is None else at - start

    return since(watch.detected_s), since(watch.decided_s), since(watch.first.get(key))


def _text(row: dict[str, Any]) -> str:
    parts = [f"{row['node']:<16}"]
    for figure in ("detected", "decided", "output"):
        value = row.get(figure)
        parts.append(f"{figure} {value['median_ms']:6.1f} ms ({value['min_ms']:.1f} to "
                     f"{value['max_ms']:.1f}, n={value['n']})" if value else f"{figure} -")
    return "  ".join(parts)


def main() -> int:
    """Parse the command line, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--kills", type=int, default=20, help="kills per node (default: 20)")
    parser.add_argument("--node", action="append", choices=list(OUTPUT), help="only this node")
    parser.add_argument("--system", default="systems/osmosis.toml")
    parser.add_argument("--port", type=int, default=7950)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    rows = asyncio.run(measure(options))
    if options.json:
        print(json.dumps(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
