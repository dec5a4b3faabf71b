"""Who hangs and who merely waits for a processor, who was absent, and what each uses."""

import os
import signal
import subprocess
import sys
import time

import psutil
import pytest

from rampart.actors.machine.absence import ABSENT_S, GRACE_S, Absence
from rampart.actors.machine.patience import AT_LEISURE, Patience, Usage, usage
from rampart.actors.machine.process_usage import ProcessCount, UsageMeter, read_count
from rampart.testing import wait_until


def rounds(state: str, ran_s: float, waited_s: float, count: int = 100, every_s: float = 0.25
           ) -> float | None:
    """Return after how long patience of one second is over, None if it never is.

    Args:
        state: the letter of the kernel at each look.
        ran_s: what the process has run between two looks.
        waited_s: and waited for a processor, as far as the kernel has counted it.
    """
    patience = Patience(0.5)
    for i in range(count):
        if patience.look(i * every_s, 7, Usage(state, i * ran_s, i * waited_s)) >= 1.0:
            return i * every_s
    return None


@pytest.mark.parametrize(("how", "over_s"), [
    (("T", 0.0, 0.0), 1.0),  # stopped
    (("S", 0.0, 0.0), 1.0),  # asleep with a request in its queue: wedged
    (("R", 0.25, 0.0), 1.0),  # spins
    (("R", 0.05, 0.2), 5.0),  # spins, with a fifth of a processor
    (("R", 0.0, 0.0), None),  # waits, and the kernel counts only when the wait is over
    (("R", 0.0, 0.25), None),  # waits
    (("S", 0.0, 0.24), 25.0),  # waits nearly always: what is left is too little to answer in
    (("D", 0.0, 0.0), None),  # the kernel lets it wait
])
def test_only_time_in_which_it_could_have_run_counts(how, over_s):
    found = rounds(*how)
    assert found == (None if over_s is None or over_s >= 25 else pytest.approx(over_s, abs=0.25))


@pytest.mark.parametrize(("looks", "counted_s"), [
    ([(0.0,), (60.0,), (60.25,)], [0.0, 0.5, 0.75]),  # the observer itself stood still
    ([(10.0, 8.0), (10.25, 8.0)], [2.0, 2.25])])  # what it owes for longer counts from then
def test_time_between_looks_counts_as_far_as_both_could_run(looks, counted_s):
    patience = Patience(0.5)
    assert [patience.look(at, 7, AT_LEISURE, *since) for at, *since in looks] == counted_s


@pytest.mark.parametrize(("ran_s", "counted_s"), [(0.2, 2.2), (0.0, 0.0), (0.1, 0.1)])
def test_whether_the_time_before_the_first_look_counts_shows_at_the_second(ran_s, counted_s):
    patience = Patience(0.5)
    assert patience.look(10.0, 7, Usage("R", 5.0, 5.0), 8.0) == 0.0
    assert patience.look(10.21, 7, Usage("R", 5.0 + ran_s, 5.0)) == pytest.approx(counted_s)


def test_a_thread_that_is_on_the_run_queue_makes_its_process_one_that_is():
    code = ("import threading, sys, time\n"
            "def spin():\n    while True: hash('x' * 9)\n"
            "threading.Thread(target=spin, daemon=True).start()\n"
            "sys.setswitchinterval(1000)\ntime.sleep(1000)")
    with subprocess.Popen([sys.executable, "-c", code]) as process:
        try:
            wait_until(lambda: usage(process.pid).state == "R", 20, lambda: "it never spins")
            seen = {usage(process.pid).state for _ in range(20)}
            assert seen == {"R"}
        finally:
            process.kill()


def test_of_one_that_ends_between_two_looks_there_is_nothing_to_see(monkeypatch):
    monkeypatch.setattr("rampart.actors.machine.patience.process_state", lambda _pid: "S")
    assert usage(2**22 + 1) == AT_LEISURE


def test_an_answer_and_another_process_begin_anew():
    for begin, pid in ((lambda p: p.answered(), 7), (lambda _: None, 8)):
        patience = Patience(0.5)
        assert [patience.look(at, 7, AT_LEISURE) for at in (0.0, 0.5)] == [0.0, 0.5]
        begin(patience)
        assert [patience.look(at, pid, AT_LEISURE) for at in (1.0, 1.5)] == [0.0, 0.5]


def test_the_kernel_tells_who_runs_and_who_is_stopped():
    child = subprocess.Popen([sys.executable, "-c", "while True: pass"])
    try:
        wait_until(lambda: usage(child.pid).ran_s >= 0.05, 20)
        child.send_signal(signal.SIGSTOP)
        wait_until(lambda: usage(child.pid).state == "T", 20)
        assert usage(child.pid).ran_s == usage(child.pid).ran_s
    finally:
        child.kill()
        child.wait()
    assert usage(child.pid) == Usage("X", 0.0, 0.0)
    assert usage(os.getpid()).state == "R"


@pytest.mark.parametrize("rate", [1.0, 4.0])
def test_one_that_was_stopped_is_excused_for_a_grace_in_real_seconds_that_covers_the_others(rate):
    absence, grace_s = Absence(0.0, rate=rate), rate * GRACE_S
    assert [absence.note(0.2 * n) for n in range(1, 50)] == [0.0] * 49
    assert not absence.excuses(9.8)
    assert absence.note(39.8) == pytest.approx(30.0)
    assert absence.excuses(39.8 + 0.9 * grace_s)
    assert not absence.excuses(39.8 + grace_s)


def test_one_that_is_always_late_is_not_always_excused():
    absence, now_s, excused = Absence(0.0), 0.0, 0
    for _ in range(100):
        now_s += ABSENT_S + 0.05
        absence.note(now_s)
        excused += absence.excuses(now_s)
    assert 0 < excused < 50


def test_a_process_is_as_psutil_sees_it_whatever_its_name_and_left_out_when_it_has_ended(tmp_path):
    count, other = read_count(os.getpid()), psutil.Process()
    assert count.memory_bytes == pytest.approx(other.memory_info().rss, rel=0.2)
    assert count.cpu_s == pytest.approx(sum(other.cpu_times()[:2]), abs=1.0)
    program = tmp_path / "a) S (b"
    program.symlink_to("/bin/sleep")
    with subprocess.Popen([program, "60"]) as process:
        started_s = read_count(process.pid).started_s
        process.kill()
    assert 0 <= time.clock_gettime(time.CLOCK_BOOTTIME) - started_s < 60
    assert read_count(process.pid) is None
    assert UsageMeter().look([process.pid, 0, -5]) == {}


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
