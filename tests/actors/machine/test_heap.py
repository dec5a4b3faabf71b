"""The C heap: what is free between what is in use goes back, by the router's timer too."""

from __future__ import annotations

import asyncio
import ctypes

import psutil
import pytest

from rampart.actors.machine import heap
from rampart.actors.supervision.router import GIVE_BACK_S, Router
from rampart.testing.virtual import VirtualSystem, run

BLOCKS, BLOCK, EACH_KEPT = 60_000, 512, 100


@pytest.fixture
def holes():
    """The C heap is as after many deaths: free, but for a little here and there."""
    libc = ctypes.CDLL(None)
    libc.malloc.restype, libc.free.argtypes = ctypes.c_void_p, [ctypes.c_void_p]
    blocks = [libc.malloc(BLOCK) for _ in range(BLOCKS)]
    for block in blocks:
        ctypes.memset(block, 1, BLOCK)
    kept = blocks[::EACH_KEPT]
    for i, block in enumerate(blocks):
        if i % EACH_KEPT:
            libc.free(block)
    yield
    for block in kept:
        libc.free(block)


def resident() -> int:
    return psutil.Process().memory_info().rss


def test_pages_between_what_is_in_use_go_back(holes):
    before = resident()
    heap.give_back()
    assert resident() < before - BLOCKS * BLOCK // 2


def test_a_router_gives_back_what_the_dead_have_left(holes):
    async def scenario() -> tuple[int, int]:
        async with VirtualSystem() as system:
            system.start("router_a", Router)
            early = resident()
            await asyncio.sleep(GIVE_BACK_S + 0.1)
            return early, resident()

    early, late = run(scenario)
    assert late < early - BLOCKS * BLOCK // 2


def test_a_c_library_that_cannot_is_left_alone(monkeypatch):
    monkeypatch.setattr(ctypes, "CDLL", lambda _name: object())
    heap.give_back()
