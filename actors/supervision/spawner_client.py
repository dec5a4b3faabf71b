"""The supervisor's and the launcher's side of the spawners: fork through whichever lives.

A spawner that does not answer in time is killed before the other one is asked, so that no
second process of the same incarnation can appear later. It may have forked before: its child is
looked for.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
from collections.abc import Callable

import msgspec

from actors.messages import AdaptedSystem
from actors.runtime.unix_peer import peer
from actors.supervision.spawner import (
    MAX_DATAGRAM,
    NAMES,
    Adapt,
    ForkRequest,
    Ping,
    Reply,
    Request,
    SetOrigin,
    address,
)

ANSWER_TIMEOUT_S = 0.25
"""A fork takes a millisecond; a spawner that needs this long is stopped or hung."""


class SpawnerUnavailableError(Exception):
    """No spawner answered."""


class SpawnerClient:
    """Talks to the spawners of the run in one folder. Blocking, a millisecond or so."""

    def __init__(self, folder: str) -> None:
        self._folder = folder
        self._connections: dict[str, socket.socket] = {}
        self._adapt: Adapt | None = None
        self._unanswered = False

    def fork(
        self, names: tuple[str, ...], incarnation: int, orphan: Callable[[], int] = lambda: 0,
    ) -> int:
        """Fork a process for the named actors and return its pid.

        Args:
            names: of the actors.
            incarnation: of the process.
            orphan: returns the pid of that process if it is there already, else 0; asked when a
                spawner heard the request and did not answer.

        Raises:
            SpawnerUnavailableError: no spawner could do it.
        """
        failures = []
        for name in NAMES:
            if names == (f"spawner_{name}",):
                continue
            reply = self.ask(name, ForkRequest(names, incarnation))
            if reply is not None and reply.child:
                return reply.child
            if self._unanswered and (child := orphan()):
                return child
            failures.append(f"spawner_{name}: {reply.error if reply else 'no answer'}")
        raise SpawnerUnavailableError("; ".join(failures))

    def ping(self, name: str) -> bool:
        """Whether a spawner turns; one that hangs is killed."""
        return self.ask(name, Ping()) is not None

    def set_origin(self, origin_s: float) -> None:
        """Tell the first spawner when simulated time starts."""
        if self.ask(NAMES[0], SetOrigin(origin_s)) is None:
            raise SpawnerUnavailableError("spawner_a: no answer")

    def adapt(self, adapted: AdaptedSystem) -> None:
        """Have the spawners fork by a changed system from now on, those still to come included."""
        self._adapt = Adapt(msgspec.json.encode(adapted).decode())
        for name in NAMES:
            self.ask(name, self._adapt)

    def ask(self, name: str, request: Request) -> Reply | None:
        """Send a request and return the reply, or None if the spawner is dead or was hung."""
        self._unanswered = False
        for _ in range(2):  # a kept connection may be to a spawner that has been replaced
            connection = self._connections.pop(name, None)
            requests = [request]
            if connection is None:
                connection = self._connect(name)
                if self._adapt is not None and request is not self._adapt:
                    requests.insert(0, self._adapt)  # it may have loaded the file as it was
            if connection is None:
                return None
            try:
                for one in requests:
                    connection.send(msgspec.json.encode(one))
                    self._unanswered = True
                    data = connection.recv(MAX_DATAGRAM)
            except TimeoutError:
                _kill_peer(connection)
                connection.close()
                return None
            except OSError:
                data = b""
            if data:
                self._unanswered = False
                self._connections[name] = connection
                return msgspec.json.decode(data, type=Reply)
            connection.close()
        return None

    def close(self) -> None:
        """Close the connections."""
        for connection in self._connections.values():
            connection.close()
        self._connections.clear()

    def _connect(self, name: str) -> socket.socket | None:
        try:
            connection = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        except OSError:  # no descriptor left
            return None
        connection.settimeout(ANSWER_TIMEOUT_S)
        try:
            connection.connect(address(self._folder, name))
        except OSError:
            connection.close()
            return None
        return connection


def _kill_peer(connection: socket.socket) -> None:
    pid, _ = peer(connection)
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, signal.SIGKILL)
