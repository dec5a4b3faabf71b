"""Networks of this machine's own, joined by a line that may be slow, lossy, disordered, or cut.

Each host is a network namespace with a loopback and one TUN device (tun in the kernel's
documentation of networking). What it sends comes as a packet to a thread of this process, which
hands it on to the host it is for, later or not at all. It takes the privileges to make namespaces;
`why_not` says whether there are.
"""

import contextlib
import fcntl
import heapq
import os
import random
import select
import shutil
import struct
import subprocess
import threading
import time
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path

_TUN = Path("/dev/net/tun")
_TUNSETIFF, _IFF_TUN, _IFF_NO_PI = 0x400454CA, 0x0001, 0x1000  # linux/if_tun.h
_MTU = 1500
_DESTINATION = slice(16, 20)  # of an IPv4 header
_NUMBERS = count()


def why_not() -> str:
    """Return why there can be no networks here; "" if there can."""
    if not _TUN.exists() or shutil.which("ip") is None:
        return f"no {_TUN}, or no command ip (package iproute2)"
    made = subprocess.run(["ip", "netns", "add", name := f"rampart-probe-{os.getpid()}"],
                          capture_output=True, text=True, check=False)
    if made.returncode:
        return f"no network namespaces: {made.stderr.strip()}"
    _ip("netns", "del", name)
    return ""


@dataclass
class Line:
    """What happens to each packet.

    Attributes:
        delay_s: On its way.
        jitter_s: At most so much longer, evenly distributed: that changes the order.
        loss: Share that never arrives.
        is_cut: None arrives.
    """

    delay_s: float = 0.0
    jitter_s: float = 0.0
    loss: float = 0.0
    is_cut: bool = False


@dataclass
class Network:
    """Hosts that reach each other over a line.

    Attributes:
        addresses: Of the hosts, by name.
        line: Between any two; may be changed while packets go by.
        apart: Pairs of hosts that do not reach each other, whatever the line; may be changed, too.
    """

    addresses: dict[str, str]
    line: Line = field(default_factory=Line)
    apart: frozenset[frozenset[str]] = frozenset()

    def __post_init__(self) -> None:
        self._prefix = f"rampart-{os.getpid()}-{next(_NUMBERS)}"
        self._devices: dict[bytes, int] = {}
        self._hosts: dict[int, str] = {}
        self._over, self._end = os.pipe()
        self._random = random.Random(1)
        self._thread = threading.Thread(target=self._hand_on, name="network")

    def namespace(self, host: str) -> str:
        """Return the name of a host's network namespace."""
        return f"{self._prefix}-{host}"

    def part(self, *pairs: tuple[str, str]) -> None:
        """Have these pairs of hosts not reach each other, and all others."""
        self.apart = frozenset(map(frozenset, pairs))

    def command(self, host: str, *command: str) -> list[str]:
        """Return the command line that runs a command on a host."""
        return ["ip", "netns", "exec", self.namespace(host), *command]

    def open(self) -> None:
        """Make namespaces and devices, and hand on what they send."""
        for place, (host, address) in enumerate(self.addresses.items()):
            name, device = self.namespace(host), f"rt{os.getpid() % 100_000}x{place}"
            _ip("netns", "add", name)
            descriptor = os.open(_TUN, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
            fcntl.ioctl(descriptor, _TUNSETIFF, struct.pack(
                "16sH22x", device.encode(), _IFF_TUN | _IFF_NO_PI))
            self._devices[bytes(map(int, address.split(".")))] = descriptor
            self._hosts[descriptor] = host
            _ip("link", "set", device, "netns", name)
            for words in (("link", "set", "lo", "up"),
                          ("address", "add", f"{address}/24", "dev", device),
                          ("link", "set", device, "mtu", str(_MTU), "up")):
                _ip("-n", name, *words)
        self._thread.start()

    def close(self) -> None:
        """Remove them."""
        if self._thread.ident is not None:
            os.write(self._end, b"x")
            self._thread.join()
        for descriptor in (*self._devices.values(), self._over, self._end):
            os.close(descriptor)
        for host in self.addresses:
            subprocess.run(["ip", "netns", "del", self.namespace(host)], check=False,
                           capture_output=True)

    def _hand_on(self) -> None:
        waiting: list[tuple[float, int, int, bytes]] = []
        numbers = count()
        devices = list(self._devices.values())
        while True:
            due_s = max(0.0, waiting[0][0] - time.monotonic()) if waiting else None
            readable, _, _ = select.select([*devices, self._over], [], [], due_s)
            if self._over in readable:
                return
            now_s = time.monotonic()
            for device in readable:
                for packet in _packets(device):
                    line, to = self.line, self._devices.get(packet[_DESTINATION])
                    if (to is None or line.is_cut or self._random.random() < line.loss
                            or {self._hosts[device], self._hosts[to]} in self.apart):
                        continue
                    later_s = line.delay_s + self._random.random() * line.jitter_s
                    heapq.heappush(waiting, (now_s + later_s, next(numbers), to, packet))
            while waiting and waiting[0][0] <= now_s:
                _, _, to, packet = heapq.heappop(waiting)
                with contextlib.suppress(OSError):  # its queue is full, or it is down
                    os.write(to, packet)


def _packets(device: int) -> Iterator[bytes]:
    with contextlib.suppress(BlockingIOError):
        while True:
            yield os.read(device, _MTU)


@contextlib.contextmanager
def network(hosts: Collection[str]) -> Iterator[Network]:
    """Have a network with these hosts."""
    made = Network({host: f"10.77.0.{place}" for place, host in enumerate(hosts, 1)})
    try:
        made.open()
        yield made
    finally:
        made.close()


def _ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True, capture_output=True, text=True)

