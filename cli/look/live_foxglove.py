"""Views for viewers that speak Foxglove's WebSocket protocol, over `foxglove-sdk`.

The server runs on threads of the SDK. A channel keeps no messages, and most of the scene changes
hardly ever; so whoever subscribes to a channel is given its last message again, from the event
loop. Nothing is encoded for a channel that nobody looks at, and clients can only read.
"""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from typing import Any

import foxglove
from foxglove.websocket import ChannelView, Client, ServerListener

from rampart.actors.recording import foxglove as fg
from rampart.actors.recording.json_schema import plain_schema
from rampart.actors.recording.views import encode
from rampart.actors.run.run_info import RunInfo


class FoxgloveViewer(ServerListener):
    """A server; to be made on the event loop.

    Args:
        host: address to serve on.
        port: port; 0 lets the system choose one.

    Raises:
        RuntimeError: the address is taken, or there is none such.
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
        """Have viewers forget an earlier run, and tell them of the channels of this one."""
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
        """Send a view to those who look at its channel."""
        self._last[channel] = (record, at_ns)
        if self._channels[channel].has_sinks():
            self._channels[channel].log(encode(record), log_time=at_ns)

    def close(self) -> None:
        """Stop serving."""
        self._server.stop()

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:  # noqa: ARG002
        """Somebody looks at a channel; called on a thread of the SDK."""
        name = self._names.get(channel.id)
        if name is not None and self._loop is not None and not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._again, name)

    def _again(self, name: str) -> None:
        if name in self._last:
            self.show(name, *self._last[name])
