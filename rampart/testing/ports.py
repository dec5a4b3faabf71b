"""Free TCP ports, and free base ports that identify runs."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from itertools import cycle, islice

from rampart.actors.bus import run_info


def bases() -> Iterator[int]:
    """Yield base ports that no other worker of this test run takes, below the ephemeral ports.

    Otherwise two workers of pytest-xdist could find the same port free before either uses it.
    """
    worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
    workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    of_this_worker = range(10_000 + worker * 40, 32_000, workers * 40)
    test_run = os.getppid() if workers > 1 else os.getpid()  # two runs of one test differ
    start = test_run % len(of_this_worker)
    return cycle((*of_this_worker[start:], *of_this_worker[:start]))


_BASES = bases()


def free_base_port() -> int:
    """Return a base port for `--port` that no run uses and that is free as a TCP port.

    Raises:
        RuntimeError: None of a thousand is free.
    """
    for base in islice(_BASES, 1000):
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as probe:
                probe.bind(run_info.address(base))
            with socket.create_server(("127.0.0.1", base)):  # for the operator's page
                pass
        except OSError:
            continue
        return base
    raise RuntimeError("no free base port among 1000")


def free_port() -> int:
    """Return a TCP port of the loopback interface that is free now."""
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return int(found.getsockname()[1])
