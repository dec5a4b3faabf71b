"""Turns on a processor: who has short ones, and that nothing else changes."""

from __future__ import annotations

import ctypes
import os
import struct
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest

from rampart.actors.machine import turns

_GET = {"x86_64": 315, "aarch64": 275}
_SHORT_NS = 200_000


def turn_ns() -> int:
    """Return what the kernel says of the calling thread (sched_getattr(2))."""
    found = ctypes.create_string_buffer(56)
    libc = ctypes.CDLL(None, use_errno=True)
    assert libc.syscall(_GET[os.uname().machine], 0, found, 56, 0) == 0
    return struct.unpack("IIQiIQQQII", found.raw)[5]


def in_a_thread(call: Callable[[], Any]) -> Any:
    """Return what a call returns that is made in a thread of its own, which keeps its turns."""
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(call).result(10)


USUAL_NS = turn_ns()
needs_turns = pytest.mark.skipif(
    USUAL_NS == 0, reason="this kernel is older than Linux 6.12, which has no such turns")


@needs_turns
def test_what_a_thread_asks_for_its_heirs_have_too():
    def ask() -> list[int]:
        turns.short()
        return [turn_ns(), in_a_thread(turn_ns)]

    assert in_a_thread(ask) == [_SHORT_NS, _SHORT_NS]
    assert turn_ns() == USUAL_NS, "they are of the thread that asked"


@needs_turns
def test_a_program_of_somebody_elses_has_usual_ones():
    def ask() -> list[int]:
        turns.short()
        with turns.usual():
            found = [turn_ns()]
        return [*found, turn_ns()]

    assert in_a_thread(ask) == [USUAL_NS, _SHORT_NS]


@pytest.mark.parametrize("policy", [os.SCHED_BATCH, os.SCHED_OTHER])
def test_niceness_and_policy_stay_as_they_were_chosen(policy):
    read, write = os.pipe()
    if os.fork() == 0:
        os.sched_setscheduler(0, policy, os.sched_param(0))
        os.nice(3)
        turns.short()
        os.write(write, f"{os.sched_getscheduler(0)} {os.nice(0)}".encode())
        os._exit(0)
    os.wait()
    assert os.read(read, 100) == f"{policy} {os.nice(0) + 3}".encode()
    os.close(read)
    os.close(write)
