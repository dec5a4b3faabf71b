"""`rampart live metrics`: a picture of the run as Prometheus metric families, and their server.

Names follow Prometheus' practice: base units, and `_total` for counters. Times are simulated
seconds, except processor time. Messages, decisions, detections and recoveries count from the
exporter's start; the other counters are those of the run or of an incarnation. The
function `rate()` of Prometheus handles the reset at the next run or incarnation.

The server follows runs, and answers scrapes. Both happen on one event loop, so no message changes
the picture during a scrape.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field

from prometheus_client import CollectorRegistry, make_asgi_app
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, InfoMetricFamily, Metric

from rampart.actors.bus.run_info import RunInfo, ask
from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.machine.process_usage import ProcessCount, read_count
from rampart.actors.web.listening import listen
from rampart.actors.web.server import WebServer
from rampart.cli.output import between, say
from rampart.cli.run_picture import RunPicture, Watch
from rampart.cli.session import LOOK_S, days_left, is_over, pause, sessions, stopped_by_signals

Row = tuple[tuple[str, ...], float]
"""Values of the labels, and the value."""


@dataclass(frozen=True, slots=True)
class Exposition:
    """One run at the time of a scrape.

    Attributes:
        run: the run.
        time_s: simulated time.
        picture: messages of the run.
        processes: counts of the kernel by process name.
    """

    run: RunInfo
    time_s: float
    picture: RunPicture
    processes: Mapping[str, ProcessCount] = field(default_factory=dict)


def families(now: Exposition | None) -> Iterator[Metric]:
    """Yield all families; without a run only `rampart_up`."""
    yield gauge("up", "Whether there is a run.", (), [((), float(now is not None))])
    if now is None:
        return
    run = now.run
    yield InfoMetricFamily("rampart_run", "The run.", value={
        "run_id": run.run_id, "title": run.title, "port": str(run.base_port),
        "rate": f"{run.rate:g}"})
    if run.recording:
        yield gauge("recording", "Whether the run is being recorded; 0 if the recorder has ended.",
                    (), [((), float(not run.recording_problem))])
    yield gauge("simulated_seconds", "Simulated time of the run.", (), [((), now.time_s)])
    if left := days_left(run):
        yield gauge("certificate_days_left", "Days until the certificate of a process expires.",
                    ("process",), [((name,), days) for name, (days, _) in sorted(left.items())])
    yield from _nodes(now)
    yield from _mechanisms(now.picture)
    yield from now.picture.lines.families(now.picture.latest)
    yield from _traffic_and_load(now)


def gauge(name: str, doc: str, labels: tuple[str, ...], rows: Iterable[Row]) -> Metric:
    """Return a gauge with a row for each value of its labels."""
    return _filled(GaugeMetricFamily(f"rampart_{name}", doc, labels=labels), rows)


def counter(name: str, doc: str, labels: tuple[str, ...], rows: Iterable[Row]) -> Metric:
    """Return a counter with a row for each value of its labels."""
    return _filled(CounterMetricFamily(f"rampart_{name}", doc, labels=labels), rows)


def _filled(family: GaugeMetricFamily | CounterMetricFamily, rows: Iterable[Row]) -> Metric:
    for values, value in rows:
        family.add_metric(values, value)
    return family


def _nodes(now: Exposition) -> Iterator[Metric]:
    table: fm.NodeTable | None = now.picture.latest(ftm_topics.NODES)
    nodes = table.nodes if table else ()
    yield gauge("node_up", "Whether a node runs, as the supervisor sees it.", ("node", "kind"), [
        ((n.name, n.kind), float(n.state is fm.NodeState.RUNNING)) for n in nodes])
    yield counter("node_restarts", "How often a node was restarted in this run.", ("node",), [
        ((n.name,), n.restarts) for n in nodes])
    beats = [n for n in nodes if n.heard_s]
    yield gauge("heartbeat_age_seconds", "Simulated seconds since a node's last heartbeat.",
                ("node",), [((n.name,), max(0.0, now.time_s - n.heard_s)) for n in beats])
    yield counter("rejected_payloads", "Payloads that this incarnation of a node refused.",
                  ("node",), [((n.name,), n.rejected_payloads) for n in beats])
    yield counter("overflowed_commands", "Commands lost because the mailbox of a node was full.",
                  ("node",), [((n.name,), n.overflowed) for n in beats])


def _mechanisms(picture: RunPicture) -> Iterator[Metric]:
    detections = sorted(picture.detections.items())
    recoveries = sorted(picture.recoveries.items())
    yield gauge("detection_active", "Whether a module detects.", ("module",), [
        ((name,), float(report.state is fm.DetectionState.ACTIVE)) for name, report in detections])
    yield counter("detections", "How often a module began to detect.", ("module",), [
        ((name,), picture.detections_total[name]) for name, _ in detections])
    yield gauge("recovery_activated", "Whether a recovery is in force.", ("module",), [
        ((name,), float(report.state is fm.RecoveryState.ACTIVATED))
        for name, report in recoveries])
    yield counter("recoveries", "How often a recovery was activated.", ("module",), [
        ((name,), picture.recoveries_total[name]) for name, _ in recoveries])
    yield counter("decisions", "Decisions of the FTM Manager.", ("strategy",), [
        ((name,), count) for name, count in sorted(picture.decisions_total.items())])


def _traffic_and_load(now: Exposition) -> Iterator[Metric]:
    found = sorted(now.processes.items())
    yield counter("messages", "Messages by topic, with all members of a family.", ("topic",), [
        ((key,), count) for key, count in sorted(now.picture.messages.items())])
    yield counter("process_cpu_seconds", "Processor time, real seconds.", ("process",), [
        ((name,), count.cpu_s) for name, count in found])
    yield gauge("process_resident_memory_bytes", "Resident set; most of it is shared.",
                 ("process",), [((name,), count.memory_bytes) for name, count in found])


async def metrics(options: argparse.Namespace) -> int:
    """Serve until interrupted."""
    stop = asyncio.Event()
    between("--port", options.port, 0, 65535)
    listening = listen(options.host, options.port)
    exporter = Exporter()
    registry = CollectorRegistry()
    registry.register(exporter)
    server = WebServer(make_asgi_app(registry), listening)
    with stopped_by_signals(stop):
        server.start()
        host = f"[{options.host}]" if ":" in options.host else options.host
        say(f"metrics at http://{host}:{listening.getsockname()[1]}/metrics")
        try:
            await exporter.follow(options.of, stop)
        finally:
            server.stop()
    return 0


class Exporter:
    """Follows runs; `prometheus_client` collects its families at each scrape."""

    def __init__(self) -> None:
        self._watch: Watch | None = None

    async def follow(self, port: int | None, stop: asyncio.Event) -> None:
        """Follow one run after the other until `stop`."""
        async with contextlib.aclosing(sessions(port, stop)) as found:
            async for session in found:
                self._watch = Watch(session)
                while not stop.is_set() and not is_over(session.run):
                    self._watch.look()
                    await pause(stop, LOOK_S)
                self._watch = None

    def look(self) -> Exposition | None:
        """Return the present exposition, None without a run."""
        if self._watch is None:
            return None
        session, picture = self._watch.session, self._watch.picture
        table = picture.latest(ftm_topics.NODES)
        # The process numbers of a replay or another host may belong to other processes here.
        nodes = [node for node in table.nodes if node.host == session.run.host
                 ] if table and not session.run.replay_of else ()
        pids = {node.name: node.pid for node in nodes} | {
            row["name"]: row["pid"] for row in self._watch.used["guards"]}
        return Exposition(
            ask(session.run.base_port) or session.run, session.clock.now(), picture,
            {name: count for name, pid in pids.items() if (count := read_count(pid)) is not None})

    def collect(self) -> Iterator[Metric]:
        """Yield the present families."""
        return families(self.look())
