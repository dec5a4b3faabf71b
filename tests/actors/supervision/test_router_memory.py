"""The C heap: what is large goes back when it is freed, though what is small lies beside it."""

from __future__ import annotations

import subprocess
import sys

import pytest

KEPT_MB = """
import ctypes
import psutil
from rampart.actors.supervision.router import LARGE_BYTES, Router
from rampart.testing.virtual import VirtualSystem, run

async def one():
    async with VirtualSystem() as system:
        system.start("router_a", Router)

if {as_router}:
    run(one)
libc = ctypes.CDLL(None)
libc.malloc.restype, libc.free.argtypes = ctypes.c_void_p, [ctypes.c_void_p]
before, large, small = psutil.Process().memory_info().rss, [], []
for _ in range(400):
    large.append(libc.malloc(2 * LARGE_BYTES))
    ctypes.memset(large[-1], 1, 2 * LARGE_BYTES)
    small.append(libc.malloc(LARGE_BYTES // 2))
for block in large:
    libc.free(block)
print((psutil.Process().memory_info().rss - before) / 1e6)
"""
"""What a process has more, when all that was large, 26 MB, has been freed."""


@pytest.mark.parametrize(("as_router", "least", "most"), [(True, -1, 10), (False, 20, 40)])
def test_a_router_keeps_nothing_of_what_was_large(as_router, least, most):
    done = subprocess.run([sys.executable, "-c", KEPT_MB.format(as_router=as_router)],
                          capture_output=True, text=True, check=True, timeout=60)
    assert least < float(done.stdout) < most
