"""Does a router's memory grow while its clients are killed and come back?

Two linked routers and ten clients that stay; each declares what a node does: token, subscriptions,
publishers with their queryables, four nodes that it watches. One more is killed and comes back as
the next incarnation, again and again. Shown is the heap that each router has in use
(malloc_info(3): what the allocator keeps for later is not in it) and its private memory.

Example: `python -m benchmarks.router_memory --kills 600`, 75 s.
"""

from __future__ import annotations

import argparse
import asyncio
import ctypes
import os
import re
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

from rampart.actors.bus.run_folder import ROUTERS
from rampart.actors.bus.topic import Topic
from rampart.actors.bus.zenoh_bus import ZenohBus
from rampart.actors.bus.zenoh_session import endpoint, endpoints
from rampart.actors.osmosis import topics
from rampart.actors.supervision.router import keep_large_apart

CLIENTS = 10
LIFE_S = 0.12
_ROWS = 4
_SENSOR: Topic[Any] = topics.POSE


def forked(run: Callable[[], Coroutine[Any, Any, None]]) -> int:
    """Return the pid of a process that runs a coroutine."""
    pid = os.fork()
    if pid == 0:
        try:
            asyncio.run(run())
        finally:
            os._exit(1)
    return pid


def router(folder: str, name: str) -> int:
    """Start a router that writes down its heap at SIGUSR1."""

    async def run() -> None:
        keep_large_apart()  # as `Router` does
        other = next(one for one in ROUTERS if one != name)
        bus = ZenohBus(name, [endpoint(folder, other)], [endpoint(folder, name)])
        await bus.open()
        asyncio.get_running_loop().add_signal_handler(
            signal.SIGUSR1, write_heap, Path(folder, f"{os.getpid()}"))
        await asyncio.Event().wait()

    return forked(run)


def write_heap(file: Path) -> None:
    """Write how many bytes of this process' heap are in use."""
    libc = ctypes.CDLL(None)
    libc.fopen.restype = ctypes.c_void_p
    stream = ctypes.c_void_p(libc.fopen(bytes(file.with_suffix(".xml")), b"w"))
    libc.malloc_info(0, stream)
    libc.fclose(stream)
    total = file.with_suffix(".xml").read_text().rpartition("</heap>")[2]

    def size(of: str) -> int:
        found = re.search(of + r'[^>]*size="(\d+)"', total)
        return int(found[1]) if found else 0

    used = (size('system type="current"') + size('type="mmap"')
            - size('type="fast"') - size('type="rest"'))
    file.with_suffix(".new").write_text(str(used))
    file.with_suffix(".new").rename(file)


def client(folder: str, number: int) -> int:
    """Start a client that declares what a node does, and publishes ten times a second."""

    async def run() -> None:
        bus = ZenohBus(f"n{number}", endpoints(folder))
        await bus.open()
        for k in range(6):
            key = f"rampart/t/{(number + k) % (CLIENTS + 1)}/0"
            bus.subscribe(key, lambda _key, _payload: None)
        for k in range(4):
            bus.publish(_SENSOR, f"rampart/t/{number}/{k}", b"x" * 100)
        while True:
            bus.publish(_SENSOR, f"rampart/t/{number}/0", b"x" * 200)
            await asyncio.sleep(0.1)

    return forked(run)


def kilobytes(folder: str, pid: int) -> tuple[float, float]:
    """Return what a router's heap has in use, and its private memory."""
    file = Path(folder, f"{pid}")
    file.unlink(missing_ok=True)
    os.kill(pid, signal.SIGUSR1)
    until_s = time.monotonic() + 5.0
    while not file.exists() and time.monotonic() < until_s:
        time.sleep(0.01)
    private = sum(int(size) for size in re.findall(
        r"Private_\w+:\s+(\d+)", Path(f"/proc/{pid}/smaps_rollup").read_text()))
    return int(file.read_text()) / 1024, float(private)


def main() -> int:
    """Print rows, and the growth per kill from the first quarter on."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--kills", type=int, default=600, help="of one client (default: 600)")
    kills = max(_ROWS, parser.parse_args().kills)
    started: list[int] = []
    rows: list[tuple[float, ...]] = []
    with tempfile.TemporaryDirectory() as folder:
        try:
            routers = []
            for name in ROUTERS:
                routers.append(router(folder, name))
                started.append(routers[-1])
                time.sleep(0.5)
            started += [client(folder, i) for i in range(CLIENTS)]
            time.sleep(2.0)
            for kill in range(kills + 1):
                victim = client(folder, CLIENTS)
                started.append(victim)
                time.sleep(LIFE_S)
                if kill % (kills // _ROWS) == 0:
                    rows.append(tuple(x for pid in routers for x in kilobytes(folder, pid)))
                    print(f"{kill:5} kills:", *(
                        f"  {name}: in use {rows[-1][2 * i]:.0f} kB, private "
                        f"{rows[-1][2 * i + 1]:.0f}" for i, name in enumerate(ROUTERS)), flush=True)
                os.kill(victim, signal.SIGKILL)
                os.waitpid(victim, 0)
                started.remove(victim)
        finally:
            for pid in reversed(started):
                os.kill(pid, signal.SIGKILL)
                os.waitpid(pid, 0)
    for i, name in enumerate(ROUTERS):
        growth = (rows[-1][2 * i] - rows[1][2 * i]) / (kills * (1 - 1 / _ROWS))
        print(f"{name}: {growth:.2f} kB a kill after the first quarter")
    return 0


if __name__ == "__main__":
    sys.exit(main())
