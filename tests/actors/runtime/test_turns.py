"""Turns on a processor: who has short ones, and that nothing else changes."""

from __future__ import annotations

import ctypes
import os
import struct
import threading

import pytest

from rampart.actors.runtime import turns

_GET = {"x86_64": 315, "aarch64": 275}


def turn_ns() -> int:
    """Return what the kernel says of the calling thread (sched_getattr(2))."""
    found = ctypes.create_string_buffer(56)
    libc = ctypes.CDLL(None, use_errno=True)
    assert libc.syscall(_GET[os.uname().machine], 0, found, 56, 0) == 0
    return struct.unpack("IIQiIQQQII", found.raw)[5]


@pytest.fixture
def usual_turn_ns():
    before = turn_ns()
    if before == 0:
        pytest.skip("this kernel is older than Linux 6.12, which has no such turns")
    yield before
    turns.usual()


def test_what_a_thread_asks_for_its_heirs_have_too(usual_turn_ns):
    turns.short()
    found: list[int] = []
    heir = threading.Thread(target=lambda: found.append(turn_ns()))
    heir.start()
    heir.join()
    assert [turn_ns(), *found] == [200_000, 200_000]
    turns.usual()
    assert turn_ns() == usual_turn_ns


def test_a_program_of_somebody_elses_has_usual_ones(usual_turn_ns):
    turns.short()
    with turns.usual_for_others():
        assert turn_ns() == usual_turn_ns
    assert turn_ns() == 200_000


@pytest.mark.parametrize("policy", [os.SCHED_BATCH, os.SCHED_OTHER])
def test_niceness_and_policy_stay_as_they_were_chosen(policy, usual_turn_ns):
    read, write = os.pipe()
    if os.fork() == 0:
        os.sched_setscheduler(0, policy, os.sched_param(0))
        os.nice(3)
        turns.short()
        os.write(write, f"{os.sched_getscheduler(0)} {os.nice(0)}".encode())
        os._exit(0)
    os.wait()
    assert os.read(read, 100) == f"{policy} 3".encode()
    os.close(read)
    os.close(write)
