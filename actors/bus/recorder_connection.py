"""A node's side of recording: it copies each message that it publishes to a recorder.

The recorder is not a subscriber. A subscriber of everything would take an eleventh of a core for
900 messages a second, nearly all of it wake-ups, and each node would pay for one more link. Instead
the recorder listens on a unix socket and empties it some twenty times a second. The price is one
system call per message during a recording, and one a second without one.

A node never waits for the recorder. A message that does not fit into the socket is lost to the
recording, and the gap in the sequence numbers shows it. Messages handed over survive a SIGKILL of
the node.
"""

from __future__ import annotations

import errno
import math
import socket
import struct
import time
from collections.abc import Callable

from rampart.actors.machine.unix_peer import is_same_user

RETRY_S = 1.0
"""Real seconds between two looks for a recorder."""

BUFFER_BYTES = 1 << 22
"""Requested size of a node's socket buffer; the kernel may grant less."""

MAX_FRAME_BYTES = 1 << 20
"""Longer messages are not recorded. The longest contain a whole system specification."""

_HEAD = struct.Struct("<dH")
_FLAGS = socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL


RECORDERS = ("recorder", "black_box")
"""A run may have one of each."""


def address(port: int, which: str = RECORDERS[0]) -> str:
    """Return the abstract socket address of a recorder of the run on a base port."""
    return f"\0rampart.{port}.{which}"


def frame(at_s: float, key: str, payload: bytes) -> bytes:
    """Return the frame for the recorder: reading of the monotonic clock, full key, payload."""
    name = key.encode()
    return _HEAD.pack(at_s, len(name)) + name + payload


def parse_head(data: bytes) -> tuple[float, bytes]:
    """Return time and key of a frame, at a third of the cost of `parse_frame`.

    Raises:
        ValueError: The data are not a frame.
    """
    if len(data) < _HEAD.size:
        raise ValueError(f"not a frame: {len(data)} bytes")
    at_s, length = _HEAD.unpack_from(data)
    if not math.isfinite(at_s):
        raise ValueError(f"not a frame: sent at {at_s}")
    return at_s, data[_HEAD.size:_HEAD.size + length]


def parse_frame(data: bytes | memoryview) -> tuple[float, str, bytes]:
    """Return time, key and payload of a frame.

    Raises:
        ValueError: The data are not a frame.
    """
    try:
        at_s, length = _HEAD.unpack_from(data)
        key = bytes(data[_HEAD.size:_HEAD.size + length])
        if len(key) < length:
            raise ValueError(f"not a frame: key of {len(key)} bytes, expected {length}")
        if not math.isfinite(at_s):
            raise ValueError(f"not a frame: sent at {at_s}")
        return at_s, key.decode(), bytes(data[_HEAD.size + length:])
    except (struct.error, UnicodeDecodeError) as error:
        raise ValueError(f"not a frame: {len(data)} bytes: {error}") from None


class RecorderConnection:
    """Connections of one bus to the recorders of its run.

    Args:
        port: Base port of the run.
        clock: Monotonic real seconds, the same for all processes of the machine.
    """

    def __init__(self, port: int, clock: Callable[[], float] = time.monotonic) -> None:
        self._addresses = [address(port, which) for which in RECORDERS]
        self._clock = clock
        self._sockets: dict[str, socket.socket] = {}
        self._next_look_s = 0.0

    def take(self, key: str, payload: bytes) -> None:
        """Record a message that is being sent. Never waits and never raises."""
        now_s = self._clock()
        if now_s >= self._next_look_s and len(self._sockets) < len(self._addresses):
            self._next_look_s = now_s + RETRY_S
            self._look()
        if not self._sockets:
            return
        data = frame(now_s, key, payload)
        if len(data) > MAX_FRAME_BYTES:
            return
        for where, connection in list(self._sockets.items()):
            try:
                connection.send(data, _FLAGS)
            except (BlockingIOError, InterruptedError):
                continue  # the recorder is behind; the next message shows the gap
            except OSError as error:
                if error.errno != errno.EMSGSIZE:  # too long: lost, and the gap shows
                    self._sockets.pop(where).close()

    def close(self) -> None:
        """Close the connections; the next message looks for recorders again."""
        while self._sockets:
            self._sockets.popitem()[1].close()

    def _look(self) -> None:
        for where in self._addresses:
            if where not in self._sockets and (found := _connected(where)) is not None:
                self._sockets[where] = found


def _connected(where: str) -> socket.socket | None:
    """Return a connection to a recorder; None if there is none, as usual."""
    try:
        connection = socket.socket(
            socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_NONBLOCK | socket.SOCK_CLOEXEC)
    except OSError:  # no descriptor left
        return None
    try:
        connection.connect(where)
        if not is_same_user(connection):
            raise PermissionError(where)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, BUFFER_BYTES)
    except OSError:
        connection.close()
        return None
    return connection
