"""The heartbeat of a command, and the socket of sd_notify(3)."""

from __future__ import annotations

import contextlib
import math
import os
import secrets
import socket
from collections.abc import Callable, Collection
from dataclasses import dataclass, field

from rampart.actors.foreign.descendants import is_below
from rampart.actors.ftm.messages import FAILURES, NEW_PROCESSES
from rampart.actors.machine.unix_peer import receive_signed

WORKING = (*NEW_PROCESSES, "running", "resumed", "adopted")
"""Events after which a process of the node works, or starts."""

_DATAGRAM_BYTES = 8192
_MOST_S = 3600.0
"""Longest extension of the timeout, real seconds."""


@dataclass(slots=True)
class Pulse:
    """The silence of a command. Pure; times are simulated seconds.

    Only time in which the node's process itself worked counts: at most `look_s` between two checks.

    Args:
        timeout_s: A command that is silent for longer hangs.
        first_s: The same until its first heartbeat.
        look_s: The longest time between two checks that counts.
        carriers: Nodes that publish its heartbeats. While one of them is down, nothing counts.
    """

    timeout_s: float
    first_s: float
    look_s: float
    carriers: Collection[str] = ()
    silent_s: float = 0.0
    has_beaten: bool = False
    _extended_s: float = 0.0
    _ends: bool = False
    _at_s: float | None = None
    _down: set[str] = field(default_factory=set)

    @property
    def limit_s(self) -> float:
        """The longest silence that is allowed now."""
        usual_s = self.timeout_s if self.has_beaten else max(self.first_s, self.timeout_s)
        return max(usual_s, self._extended_s)

    def restart(self) -> None:
        """Allow the silence of a start again."""
        self.silent_s, self.has_beaten, self._extended_s = 0.0, False, 0.0
        self._ends, self._at_s = False, None

    def note_process(self, node: str, event: str) -> None:
        """Note an event of a process, as in `ProcessEvent`."""
        if node not in self.carriers:
            return
        if event in FAILURES:
            self._down.add(node)
        elif event in WORKING:
            self._down.discard(node)
            self.restart()

    def beat(self) -> None:
        """Note a heartbeat; after `stopping` it has no effect."""
        self._down.clear()
        if not self._ends:
            self.silent_s, self.has_beaten, self._extended_s = 0.0, True, 0.0

    def extend(self, seconds: float) -> None:
        """Allow this silence from now until the next heartbeat."""
        self.silent_s, self._extended_s = 0.0, seconds

    def stopping(self) -> None:
        """Note that the command is ending, for which it has its timeout."""
        self.beat()
        self._ends = True

    def trigger(self) -> None:
        """Note that the command reports an error of itself."""
        self.silent_s = math.inf

    def is_well(self, now_s: float) -> bool:
        """Whether the silence is not too long."""
        if self._at_s is not None and not self._down:
            self.silent_s += min(max(0.0, now_s - self._at_s), self.look_s)
        self._at_s = now_s
        return self.silent_s <= self.limit_s


def extension_s(microseconds: str) -> float | None:
    """Return the value of `EXTEND_TIMEOUT_USEC=` in real seconds, an hour at most.

    Returns:
        None if the value is not a number.
    """
    if not (microseconds.isascii() and microseconds.isdecimal()):
        return None
    return min(float(microseconds) * 1e-6, _MOST_S)


class NotifySocket:
    """Receives the messages of a program to its service manager (sd_notify(3)).

    It refuses a sender that is not a descendant of this process, or has ended before it reads.

    Args:
        node: Name of the node.
        refuse: Called with "" and the reason.

    Attributes:
        name: For `$NOTIFY_SOCKET`; an abstract address.
    """

    def __init__(self, node: str, refuse: Callable[[str, str], None]) -> None:
        self._refuse = refuse
        self.name = f"@rampart-{os.getpid()}-{secrets.token_hex(4)}-{node}"
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_PASSCRED, 1)
        self.socket.setblocking(False)
        self.socket.bind(f"\0{self.name[1:]}")

    def take(self, most: int = 16) -> list[str]:
        """Return the assignments in the waiting datagrams, such as `WATCHDOG=1`, in order."""
        found: list[str] = []
        with contextlib.suppress(OSError):
            for _ in range(most):
                data, sender = receive_signed(self.socket, _DATAGRAM_BYTES)
                if sender and is_below(sender, os.getpid()):
                    found += data.decode(errors="replace").splitlines()
                else:
                    self._refuse("NOTIFY_SOCKET", "a datagram is refused: its sender is not a "
                                                  "process of the command, or has ended")
        return found

    def close(self) -> None:
        """Close the socket."""
        self.socket.close()
