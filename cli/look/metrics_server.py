"""The server of `rampart live metrics`: it follows runs, and answers scrapes.

Both happen on one event loop, so no message changes the picture during a scrape.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
from collections.abc import Iterator

from prometheus_client import CollectorRegistry, make_asgi_app
from prometheus_client.core import Metric
from starlette.types import ASGIApp

from rampart.actors.bus.run_info import ask
from rampart.actors.ftm import topics
from rampart.actors.machine.process_usage import read_count
from rampart.actors.web.listening import listen
from rampart.actors.web.server import WebServer
from rampart.cli.following import LOOK_S, Watch, is_over, sessions, stopped_by_signals
from rampart.cli.look.metrics_families import Exposition, families
from rampart.cli.output import between, say
from rampart.cli.session import pause


async def metrics(options: argparse.Namespace) -> int:
    """Serve until interrupted."""
    stop = asyncio.Event()
    between("--port", options.port, 0, 65535)
    listening = listen(options.host, options.port)
    exporter = Exporter()
    server = WebServer(_app(exporter), listening)
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
        async with contextlib.aclosing(sessions(port, stop, follow=True, option="--run")) as found:
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
        table = picture.latest(topics.NODES)
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


def _app(exporter: Exporter) -> ASGIApp:
    registry = CollectorRegistry()
    registry.register(exporter)
    return make_asgi_app(registry)
