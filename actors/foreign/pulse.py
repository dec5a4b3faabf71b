"""Whether a command still turns, by what it shows of it, and the socket of sd_notify(3)."""

from __future__ import annotations

import contextlib
import math
import os
import secrets
import socket
from dataclasses import dataclass

from rampart.actors.machine.unix_peer import receive_signed

_DATAGRAM_BYTES = 8192


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


class NotifySocket:
    """Hears what a command tells its service manager, from processes of this user only.

    Attributes:
        name: For `$NOTIFY_SOCKET`; an abstract address.
    """

    def __init__(self, node: str) -> None:
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
                if sender:
                    found += data.decode(errors="replace").splitlines()
        return found

    def close(self) -> None:
        """Hear nothing more."""
        self.socket.close()
