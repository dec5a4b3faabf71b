"""What processes use, from /proc, and from lines of it that are made up."""

from __future__ import annotations

import os
import subprocess
import sys
import time

import psutil
import pytest

from rampart.actors.machine.process_usage import ProcessCount, UsageMeter, read_count


def test_a_name_with_parentheses_and_spaces_does_not_shift_the_fields(tmp_path):
    program = tmp_path / "a) S (b"
    program.symlink_to("/bin/sleep")
    with subprocess.Popen([program, "60"]) as process:
        try:
            count = read_count(process.pid)
            assert count is not None
            assert 0 <= time.clock_gettime(time.CLOCK_BOOTTIME) - count.started_s < 60
        finally:
            process.kill()


def test_this_process_is_as_psutil_sees_it():
    count, other = read_count(os.getpid()), psutil.Process()
    assert count is not None
    assert count.memory_bytes == pytest.approx(other.memory_info().rss, rel=0.2)
    assert count.cpu_s == pytest.approx(sum(other.cpu_times()[:2]), abs=1.0)


def test_a_process_that_has_ended_is_left_out():
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    assert read_count(ended.pid) is None
    assert UsageMeter().look([ended.pid, 0, -5]) == {}


class Machine:
    """A clock and one process."""

    def __init__(self) -> None:
        self.now_s = 100.0
        self.count = ProcessCount(5.0, 1000, 90.0)
        self.meter = UsageMeter(lambda _pid: self.count, lambda: self.now_s)

    def share(self) -> float:
        return self.meter.look([7])[7].cpu_share


def test_the_first_look_is_over_the_whole_life_and_the_next_since_then():
    machine = Machine()
    assert machine.share() == 0.5
    machine.now_s, machine.count = 104.0, ProcessCount(6.0, 1000, 90.0)
    assert machine.share() == 0.25
    assert machine.meter.look([7])[7].age_s == 14.0


def test_a_pid_that_is_used_again_is_another_process():
    machine = Machine()
    machine.share()
    machine.now_s, machine.count = 104.0, ProcessCount(1.0, 1000, 102.0)
    assert machine.share() == 0.5


def test_a_process_is_forgotten_when_nobody_asks_for_it():
    machine = Machine()
    machine.share()
    machine.meter.look([])
    machine.now_s = 110.0
    assert machine.share() == 0.25


def test_a_second_look_in_the_same_instant_divides_by_nothing():
    machine = Machine()
    machine.share()
    assert machine.share() == 0.0
