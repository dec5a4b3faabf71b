"""Whether a command still turns, by what it shows of it, and the socket of sd_notify(3)."""

from __future__ import annotations

import contextlib
import math
import os
import secrets
import socket
from collections.abc import Callable
from dataclasses import dataclass

from rampart.actors.foreign.descendants import is_below
from rampart.actors.machine.unix_peer import receive_signed

_DATAGRAM_BYTES = 8192
_DIGITS, _MOST_S = 12, 3600.0
"""Of an extension of the timeout, and real seconds that it allows at most."""


@dataclass(slots=True)
class Pulse:
    """How long a command has been silent. Pure; times are simulated seconds.

    Only time in which the node's process itself turned counts: between two looks `look_s` at most.

    Args:
        timeout_s: Silent for so long, it hangs.
        first_s: Within so many it has to be heard first.
        look_s: The longest time between two looks that counts.
    """

    timeout_s: float
    first_s: float
    look_s: float
    silent_s: float = 0.0
    heard: bool = False
    _extended_s: float = 0.0
    _ends: bool = False
    _at_s: float | None = None

    @property
    def limit_s(self) -> float:
        """How long it may be silent now."""
        usual_s = self.timeout_s if self.heard else max(self.first_s, self.timeout_s)
        return max(usual_s, self._extended_s)

    def beat(self) -> None:
        """It was heard; one that ends shows by its end that it does."""
        if not self._ends:
            self.silent_s, self.heard, self._extended_s = 0.0, True, 0.0

    def extend(self, seconds: float) -> None:
        """It may be silent for so long from now on, before its next beat."""
        self.silent_s, self._extended_s = 0.0, seconds

    def stopping(self) -> None:
        """It ends by itself, within its timeout."""
        self.beat()
        self._ends = True

    def trigger(self) -> None:
        """It has said itself that something is wrong."""
        self.silent_s = math.inf

    def is_well(self, now_s: float) -> bool:
        """Whether it is not silent for too long."""
        if self._at_s is not None:
            self.silent_s += min(max(0.0, now_s - self._at_s), self.look_s)
        self._at_s = now_s
        return self.silent_s <= self.limit_s


def extension_s(microseconds: str) -> float | None:
    """Return the real seconds that `EXTEND_TIMEOUT_USEC=` asks for, an hour at most.

    Returns:
        None if that is not a number.
    """
    if not (microseconds.isascii() and microseconds.isdecimal()):
        return None
    digits = microseconds.lstrip("0") or "0"
    return min(int(digits) * 1e-6, _MOST_S) if len(digits) <= _DIGITS else _MOST_S


class NotifySocket:
    """Receives what a program sends to its service manager (sd_notify(3)).

    A sender that is not below this process, or has ended by the time of reading, is refused.

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
        """Return the assignments of the datagrams that wait, such as `WATCHDOG=1`, in order."""
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
        """Hear nothing more."""
        self.socket.close()
