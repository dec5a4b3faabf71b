"""The time from the SIGKILL of a node of a running system to the first message of its replacement.

Kills go in rounds, so that a slow moment of the machine affects all nodes. Times count from the
call of kill(2) until this process receives the report of the death, and the replacement's first
message. Works with any robot, but not with one in service.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import os
import random
import signal
import statistics
import sys
import time
from collections.abc import Mapping, Sequence
from typing import Any

import msgspec

from rampart.actors.bus.envelope import Header
from rampart.actors.bus.topic import Topic
from rampart.actors.bus.topics import HEARTBEAT
from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.runtime.run_plan import RunPlan, load_system
from rampart.actors.supervision.process_title import find_processes
from rampart.actors.system.layout import Layout
from rampart.actors.system.members import Member, load_application
from rampart.cli.output import UsageError, print_rows, progress, unknown
from rampart.cli.session import Session, connect
from rampart.manager.spec.nodes import Kind

WARM_S = 3.0
"""Real seconds in which each node publishes on all its topics."""

BACK_S = 20.0
"""Real seconds within which a replacement has to publish."""

CALM_S = 1.0
"""Real seconds between two kills, in which detection modules become idle and the pool fills."""

_ALIKE = (Kind.DETECTION, Kind.RECOVERY)


class Spread(msgspec.Struct, frozen=True):
    """Statistics of samples: number, median, 5th and 95th percentile."""

    n: int
    median: float
    low: float
    high: float


class Row(msgspec.Struct):
    """The samples of a node, one per kill, in milliseconds.

    Attributes:
        node: name of the node.
        topic: topic on which its output was measured.
        detected_ms: times until a detection module or the supervisor reported the death.
        output_ms: times until its replacement published.
        failure: why the measurement ended early, or "".
    """

    node: str
    topic: str
    detected_ms: list[float] = []
    output_ms: list[float] = []
    failure: str = ""


async def measure(options: argparse.Namespace) -> int:
    """Kill the nodes, print the table, and return the exit code."""
    async with connect(options.port) as session:
        members = {name: member for name, member in members_of(session.run.system_file).items()
                   if name in session.run.nodes}
        names = options.node or usual(members)
        for name in names:
            if name not in members:
                raise unknown("node", name, members)
        with progress() as show:
            rows = await Restarts(session, {name: members[name] for name in names}).measure(
                options.kills, show)
    print_rows(("node", "topic", "kills", "detected, ms", "output, ms (5 to 95 %)"), [
        (row.node, row.topic, len(row.output_ms), in_words(row.detected_ms),
         in_words(row.output_ms)) for row in rows],
        [{**msgspec.to_builtins(row), "detected": spread(row.detected_ms),
          "output": spread(row.output_ms)} for row in rows], as_json=options.json)
    for row in rows:
        if row.failure:
            print(f"{row.node}: {row.failure}", file=sys.stderr)
    return 1 if any(row.failure for row in rows) else 0


def members_of(system_file: str) -> dict[str, Member]:
    """Return the nodes of a system that can be killed, by name: all but its world.

    Raises:
        ValueError: the system cannot be loaded.
    """
    plan = RunPlan(system_file=system_file)
    spec = load_system(plan)
    layout = Layout(plan, spec, load_application(plan, spec))
    return {name: layout.members[name] for name in layout.unit_of
            if layout.members[name].kind is not Kind.WORLD}


def usual(members: Mapping[str, Member]) -> list[str]:
    """Return the default nodes: all, but only one detection and one recovery module."""
    first = {kind: next((m.name for m in members.values() if m.kind is kind), "")
             for kind in _ALIKE}
    return [name for name, member in members.items()
            if member.kind not in _ALIKE or first[member.kind] == name]


def regular_topics(member: Member) -> list[Topic[Any]]:
    """Return the periodic topics of a node, the fastest first, and the heartbeat last."""
    own = sorted((t for t in member.actor.outputs if t.rate_hz > 0), key=lambda t: -t.rate_hz)
    return [*own, HEARTBEAT]


class Restarts:
    """Kills nodes and measures their restarts.

    Args:
        session: the connection to the run.
        members: nodes to be killed, by name.
    """

    def __init__(self, session: Session, members: Mapping[str, Member]) -> None:
        self._session, self._members = session, members
        self._newest: dict[tuple[str, str], tuple[int, float]] = {}  # incarnation, since when
        self._detected: dict[str, float] = {}
        self._news = asyncio.Event()

    async def measure(self, kills: int, show: Any) -> list[Row]:
        """Kill each node repeatedly, in rounds.

        Args:
            kills: number of kills of each node.
            show: called with each line of progress.
        """
        for topic in {t.key: t for m in self._members.values() for t in regular_topics(m)}.values():
            self._session.listen(topic, self._output)
        self._session.listen(ftm_topics.PROCESS_EVENT, self._event)
        self._session.listen(ftm_topics.DETECTION, self._detection)
        show("listening")
        await asyncio.sleep(WARM_S)
        rows = [Row(name, self._topic_of(member)) for name, member in self._members.items()]
        for number in range(kills):
            for row in rows:
                if not row.failure:
                    show(f"round {number + 1} of {kills}: {row.node}")
                    await self._kill(row)
                    await asyncio.sleep(CALM_S * random.uniform(1, 1.1))  # out of step
        return rows

    def _topic_of(self, member: Member) -> str:
        """Return the fastest topic on which a node published, else that of its heartbeat."""
        keys = [key for key, source in self._newest if source == member.name]
        return next((key for topic in regular_topics(member) for key in keys
                     if topic.member(key) is not None),
                    HEARTBEAT.key.replace("{name}", member.name))

    def _output(self, key: str, header: Header, _body: Any) -> None:
        known = self._newest.get((key, header.source))
        if known is None or header.incarnation > known[0]:
            self._newest[key, header.source] = header.incarnation, time.monotonic()
            self._news.set()

    def _event(self, _key: str, _header: Header, event: fm.ProcessEvent) -> None:
        if event.event == "crashed":
            self._detected.setdefault(event.node, time.monotonic())

    def _detection(self, _key: str, _header: Header, report: fm.DetectionReport) -> None:
        if report.state is fm.DetectionState.ACTIVE:
            for node in report.nodes:
                self._detected.setdefault(node, time.monotonic())

    async def _kill(self, row: Row) -> None:
        running = [process for process in find_processes(self._session.run.base_port)
                   if row.node in process.names]
        if not running:
            row.failure = "no process"
            return
        victim = max(running, key=lambda process: process.incarnation)
        self._detected.pop(row.node, None)
        killed_s = time.monotonic()
        with contextlib.suppress(ProcessLookupError):
            os.kill(victim.pid, signal.SIGKILL)
        while (found := self._newest.get((row.topic, row.node), (0, 0.0)))[0] <= victim.incarnation:
            self._news.clear()
            try:
                await asyncio.wait_for(self._news.wait(), killed_s + BACK_S - time.monotonic())
            except TimeoutError:
                row.failure = f"no message on {row.topic} within {BACK_S:g} s of a SIGKILL"
                return
        row.output_ms.append(round((found[1] - killed_s) * 1e3, 2))
        if row.node in self._detected:
            row.detected_ms.append(round((self._detected[row.node] - killed_s) * 1e3, 2))


def spread(samples: Sequence[float]) -> Spread | None:
    """Return the spread of samples; None without any."""
    if not samples:
        return None
    if len(samples) == 1:
        return Spread(1, samples[0], samples[0], samples[0])
    twentieths = statistics.quantiles(samples, n=20, method="inclusive")
    return Spread(len(samples), round(statistics.median(samples), 2), round(twentieths[0], 2),
                  round(twentieths[-1], 2))


def in_words(samples: Sequence[float]) -> str:
    """Return the spread of samples for a table; "" without any."""
    found = spread(samples)
    return f"{found.median:.1f} ({found.low:.1f} to {found.high:.1f})" if found else ""


def main() -> int:
    """Measure the run of this machine, or that of a base port."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--port", type=int, metavar="N", help="base port of the run")
    parser.add_argument("--node", action="append", metavar="NAME", help="kill only this node; "
                        "repeatable (default: all, one detection and one recovery module)")
    parser.add_argument("--kills", type=int, default=5, metavar="N", help="of each node")
    parser.add_argument("--json", action="store_true", help="print JSON")
    try:
        return asyncio.run(measure(parser.parse_args()))
    except UsageError as error:
        parser.error(str(error))


if __name__ == "__main__":
    sys.exit(main())
