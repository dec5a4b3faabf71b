"""The socket by which a command publishes and subscribes without a client library.

A packet is a message: a line with the key, without `rampart/`, then the body as JSON. The line from
the command is `KEY` or `KEY STAMP`. The line to it is `KEY STAMP SOURCE INCARNATION`.
"""

from __future__ import annotations

import asyncio
import math
import select
import socket
from collections.abc import Callable, Mapping
from typing import Any

import msgspec

from rampart.actors.bus.envelope import AHEAD_S, UNREADABLE, Header
from rampart.actors.bus.topic import Qos, Topic

MAX_PACKET = 160_000
"""Bytes of a message; it fits into a socket buffer of default size."""

_PACKETS_AT_ONCE = 16
"""Packets read in one turn of the event loop, so a flood does not block it."""

_WAITING = 256
"""Messages that wait for a command that does not read."""


class Channel:
    """The node's end of the socket of a command.

    Args:
        publishes: Topics by the keys that the command may publish.
        take: Called with key, topic, body and stamp (None: now) of each valid message.
        refuse: Called with key and reason of each other message.
        now: Returns simulated seconds.

    Attributes:
        other: The command's end; closed here once the command has inherited it.
    """

    def __init__(self, publishes: Mapping[str, Topic[Any]],
                 take: Callable[[str, Topic[Any], msgspec.Struct, float | None], None],
                 refuse: Callable[[str, str], None], now: Callable[[], float]) -> None:
        self._topics = publishes
        self._decoders = {key: msgspec.json.Decoder(t.type) for key, t in publishes.items()}
        self._take = take
        self._refuse = refuse
        self._now = now
        self._waiting: dict[object, bytes] = {}
        self._count = 0
        self.mine, self.other = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.mine.setblocking(False)
        self._loop = asyncio.get_running_loop()
        self._loop.add_reader(self.mine, self._readable)

    def close(self) -> None:
        """Close both ends."""
        self._loop.remove_reader(self.mine)
        self._loop.remove_writer(self.mine)
        self._waiting.clear()
        self.mine.close()
        self.other.close()

    def send(self, key: str, topic: Topic[Any], body: msgspec.Struct, header: Header) -> None:
        """Send a message to the command. Commands queue; of other topics only the newest waits."""
        line = f"{key} {header.stamp!r} {header.source} {header.incarnation}\n"
        packet = line.encode() + msgspec.json.encode(body)
        if len(packet) > MAX_PACKET:
            self._refuse(key, f"packet of {len(packet)} bytes; at most {MAX_PACKET} are allowed")
            return
        if not self._waiting and self._sent(packet):
            return
        self._count += 1
        slot: object = self._count if topic.qos is Qos.COMMAND else key
        if slot not in self._waiting and len(self._waiting) >= _WAITING:
            self._refuse(key, "the command does not read its socket; a message to it is lost")
            return
        self._waiting[slot] = packet
        self._loop.add_writer(self.mine, self._writable)

    def _writable(self) -> None:
        for slot, packet in list(self._waiting.items()):
            if not self._sent(packet):
                return
            del self._waiting[slot]
        self._loop.remove_writer(self.mine)

    def _sent(self, packet: bytes) -> bool:
        try:
            self.mine.send(packet)
        except (BlockingIOError, InterruptedError):
            return False
        except OSError:  # it has closed its end; `ProgramProcess` reports an exit
            pass
        return True

    def _readable(self) -> None:
        for _ in range(_PACKETS_AT_ONCE):
            try:
                packet = self.mine.recv(MAX_PACKET + 1)
            except BlockingIOError:
                return
            except OSError:
                packet = b""
            if not packet and self._is_closed():
                self._loop.remove_reader(self.mine)
                return
            self._receive(packet)

    def _is_closed(self) -> bool:
        poll = select.poll()
        poll.register(self.mine, select.POLLIN)
        return any(events & (select.POLLHUP | select.POLLERR) for _, events in poll.poll(0))

    def _receive(self, packet: bytes) -> None:
        first, _, body = packet.partition(b"\n")
        key, _, stamp_text = first.decode(errors="replace").strip().partition(" ")
        topic = self._topics.get(key)
        if topic is None:
            known = ", ".join(self._topics) or "none"
            self._refuse(key, f"not one of the keys that it publishes; these are: {known}")
            return
        if len(packet) > MAX_PACKET:
            self._refuse(key, f"more than {MAX_PACKET} bytes")
            return
        try:
            stamp = float(stamp_text) if stamp_text else None
            message = self._decoders[key].decode(body)
        except UNREADABLE as error:
            self._refuse(key, f"not a {topic.type.__name__}: {error}")
            return
        if stamp is not None and not (math.isfinite(stamp) and stamp - self._now() <= AHEAD_S):
            self._refuse(key, f"stamp {stamp_text}: expected simulated seconds, not ahead of now")
            return
        self._take(key, topic, message, stamp)
