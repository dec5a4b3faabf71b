"""`rampart-stop` compiled, running, with the sockets of its two neighbours."""

import contextlib
import shutil
import socket
import struct
import subprocess
import time
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from rampart.actors.foreign.velocity_link import frame
from tests import ROOT

SOURCE = ROOT / "stop/rampart-stop.c"
TIMEOUT_MS, PERIOD_MS = 400, 10
_WHOLE = struct.Struct("=4sIQQQddd")


class Output(NamedTuple):
    """A frame that the driver of the base receives."""

    session: int
    sequence: int
    stamp_ns: int
    velocity: tuple[float, float, float]


def compiled(folder: Path) -> Path:
    """Compile the program as `make stop` does, and return its path."""
    program = folder / "rampart-stop"
    compiler = shutil.which("musl-gcc") or "gcc"
    subprocess.run([compiler, "-static", "-O2", "-Wall", "-Wextra", "-Werror", "-o", program,
                    SOURCE], check=True)
    return program


class Stopper:
    """The running program; `base` is the socket of the driver."""

    def __init__(self, program: Path, folder: Path, base: socket.socket) -> None:
        self.into = folder / "in"
        self._base = base
        self._link = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.session, self.sequence = time.monotonic_ns(), 0
        self.process = subprocess.Popen(
            [program, self.into, folder / "base", str(TIMEOUT_MS), str(PERIOD_MS), "1.0", "2.0"],
            stderr=subprocess.PIPE, text=True)
        self.next()

    def send(self, x: float = 0.5, y: float = 0.0, turn: float = 0.0, *, session: int | None = None,
             sequence: int | None = None, age_s: float = 0.0) -> bytes:
        """Send a frame, by default the next one with a fresh stamp; return it."""
        self.sequence += 1
        data = frame(session or self.session, sequence or self.sequence,
                     time.monotonic_ns() - int(age_s * 1e9), (x, y, turn))
        self.raw(data)
        return data

    def raw(self, data: bytes) -> None:
        """Send a datagram."""
        self._link.sendto(data, str(self.into))

    def next(self) -> Output:
        """Return the next frame that it sends."""
        magic, sum_, *numbers = _WHOLE.unpack(data := self._base.recv(1000))
        assert (magic, sum_) == (b"RPV1", zlib.crc32(data[8:]))
        return Output(*numbers[:3], tuple(numbers[3:]))

    def now(self) -> Output:
        """Return the first frame that is sent from now on, after what was sent is handled."""
        asked_ns = time.monotonic_ns()
        while (found := self.next()).stamp_ns < asked_ns + PERIOD_MS * 1_000_000:
            pass
        return found

    def received(self) -> list[Output]:
        """Return the frames that were sent and not read yet."""
        self._base.setblocking(False)
        found = []
        with contextlib.suppress(BlockingIOError):
            while True:
                found.append(self.next())
        self._base.settimeout(10)
        return found

    def close(self) -> None:
        """Kill it."""
        self.process.kill()
        self.process.wait()
        self.process.stderr.close()
        self._link.close()

    @property
    def speed(self) -> float:
        """The forward velocity that it hands on now."""
        return self.now().velocity[0]


@contextlib.contextmanager
def running(program: Path, folder: Path) -> Iterator[Stopper]:
    """Run the program with sockets in a folder."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as base:
        base.bind(str(folder / "base"))
        base.settimeout(10)
        stopper = Stopper(program, folder, base)
        try:
            yield stopper
        finally:
            stopper.close()
