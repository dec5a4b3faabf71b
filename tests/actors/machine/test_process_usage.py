"""What processes use, from /proc, and from lines of it that are made up."""

from __future__ import annotations

import os
import subprocess
import sys
import time

import psutil
import pytest

from rampart.actors.machine.process_usage import ProcessCount, UsageMeter, read_count


def test_this_process_is_as_psutil_sees_it():
    count, other = read_count(os.getpid()), psutil.Process()
    assert count is not None
    assert count.memory_bytes == pytest.approx(other.memory_info().rss, rel=0.2)
    assert count.cpu_s == pytest.approx(sum(other.cpu_times()[:2]), abs=1.0)


def test_a_name_with_parentheses_and_spaces_does_not_shift_the_fields(tmp_path):
    program = tmp_path / "a) S (b"
    program.symlink_to("/bin/sleep")
    with subprocess.Popen([program, "60"]) as process:
        count = read_count(process.pid)
        process.kill()
    assert count is not None
    assert 0 <= time.clock_gettime(time.CLOCK_BOOTTIME) - count.started_s < 60


def test_a_process_that_has_ended_is_left_out():
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    assert read_count(ended.pid) is None
    assert UsageMeter().look([ended.pid, 0, -5]) == {}


def test_the_share_is_over_the_whole_life_at_first_and_then_since_the_look_before():
    now_s, count = 100.0, ProcessCount(5.0, 1000, 90.0)
    meter = UsageMeter(lambda _pid: count, lambda: now_s)

    def share() -> float:
        return meter.look([7])[7].cpu_share

    assert (share(), share()) == (0.5, 0.0), "not divided by no time"
    now_s, count = 104.0, ProcessCount(6.0, 1000, 90.0)
    assert share() == 0.25
    assert meter.look([7])[7].age_s == 14.0
    now_s, count = 108.0, ProcessCount(1.0, 1000, 106.0)
    assert share() == 0.5, "the pid is used again, by another process"
    meter.look([])
    now_s = 110.0
    assert share() == 0.25, "it was forgotten, as nobody asked for it"
