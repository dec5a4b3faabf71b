"""The server of `rampart live foxglove`, with the SDK of Foxglove.

The server runs on threads of the SDK. A channel keeps no messages, and most parts of the scene
rarely change. So the event loop sends the last message of a channel again to each new subscriber.
A message is encoded only if its channel has subscribers. Clients can only read.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import functools
from collections.abc import Mapping
from typing import Any

import foxglove
from foxglove.websocket import ChannelView, Client, ServerListener

from rampart.actors.bus.envelope import Header
from rampart.actors.bus.run_info import RunInfo
from rampart.actors.bus.topic import ROOT, Topic
from rampart.actors.recording import foxglove as fg
from rampart.actors.recording.message_form import plain_schema
from rampart.actors.recording.run_documents import known_of
from rampart.actors.recording.views import encode
from rampart.cli.output import UsageError, between, say, warn
from rampart.cli.session import LOOK_S, Session, is_over, pause, sessions, stopped_by_signals


class FoxgloveViewer(ServerListener):
    """A server, constructed on the event loop.

    Args:
        host: address to serve on.
        port: port; with 0 the kernel chooses one.

    Raises:
        RuntimeError: the address is in use, or not one of this machine.
    """

    def __init__(self, host: str, port: int) -> None:
        self._context = context = foxglove.Context()  # the server does not keep it alive
        self._loop: asyncio.AbstractEventLoop | None = None
        self._last: dict[str, tuple[fg.Record, int]] = {}
        self._channels: dict[str, foxglove.Channel] = {}
        self._names: dict[int, str] = {}
        self._server = foxglove.start_server(
            name="Rampart", host=host, port=port, server_listener=self, context=context)
        self.port: int = self._server.port

    def begin(self, run: RunInfo, channels: Mapping[str, type[fg.Record]]) -> None:
        """Clear the viewers, and announce the channels of a run."""
        self._loop = asyncio.get_running_loop()
        self._last.clear()
        self._server.clear_session(run.run_id)
        for name, kind in channels.items():
            if name not in self._channels:
                self._channels[name] = made = foxglove.Channel(
                    f"/{name}", message_encoding="json", context=self._context,
                    schema=foxglove.Schema(name=fg.schema_name(kind), encoding="jsonschema",
                                           data=plain_schema(kind)))
                self._names[made.id()] = name

    def show(self, channel: str, record: Any, at_ns: int) -> None:
        """Send a view to the subscribers of its channel."""
        self._last[channel] = (record, at_ns)
        if self._channels[channel].has_sinks():
            self._channels[channel].log(encode(record), log_time=at_ns)

    def close(self) -> None:
        """Stop serving."""
        self._server.stop()

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:  # noqa: ARG002
        """Send the last message again; called on a thread of the SDK."""
        name = self._names.get(channel.id)
        if name is not None and self._loop is not None and not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._again, name)

    def _again(self, name: str) -> None:
        if name in self._last:
            self.show(name, *self._last[name])


async def live(options: argparse.Namespace) -> int:
    """Show one run after the other until interrupted."""
    between("--port", options.port, 0, 65535)
    try:
        viewer = FoxgloveViewer(options.host, options.port)
    except RuntimeError as error:
        raise UsageError(f"cannot serve on {options.host} port {options.port}: {error}; "
                         "choose another --port or --host") from None
    say(f"Foxglove viewers: ws://{options.host}:{viewer.port}")
    stop = asyncio.Event()
    try:
        with stopped_by_signals(stop):
            async with contextlib.aclosing(sessions(options.of, stop)) as found:
                async for session in found:
                    _watch(session, viewer)
                    say(f"showing {session.run.title} (port {session.run.base_port})")
                    while not stop.is_set() and not is_over(session.run):
                        await pause(stop, LOOK_S)
                    if not stop.is_set():
                        say("the run has ended; waiting for the next one, Ctrl-C ends")
    finally:
        try:
            viewer.close()
        except RuntimeError as error:
            warn(f"the viewer missed messages: {' '.join(str(error).split())}")
    return 0


def _watch(session: Session, viewer: FoxgloveViewer) -> None:
    run = session.run
    known = known_of({**run.plan, "system_file": run.system_file})
    if known.application is None:
        say("no map: the application of the run cannot be loaded here")
    views = known.views()

    def now_ns() -> int:
        return max(0, int(session.clock.now() * 1e9))

    def see(topic: Topic[Any], key: str, header: Header, body: Any) -> None:
        show(views.of(topic, f"{ROOT}/{key}", header, body, now_ns()))

    def show(found: list[tuple[str, Any]]) -> None:
        at_ns = now_ns()
        for channel, record in found:
            viewer.show(channel, record, at_ns)

    try:
        viewer.begin(run, views.channels)
    except (OSError, RuntimeError, ValueError) as error:
        raise UsageError(f"the viewer cannot be started: {' '.join(str(error).split())}") from None
    show(views.start(now_ns()))
    for topic in views.translators:
        session.listen(topic, functools.partial(see, topic))
