"""Whose loop turns: signs of life each 20 ms, and what the kernel has counted meanwhile."""

from __future__ import annotations

import pytest

from rampart.actors.detection.loop_watch import LoopWatch
from rampart.actors.detection.watchdog import WatchdogCore
from rampart.actors.machine.patience import AT_LEISURE, Usage
from rampart.testing import table, wake

PERIOD_S = 0.02


S, R, D, X, T = "SRDXT"


def found(*spans: tuple[str, float, float], until_s: float = 0.4) -> tuple[str, float | None]:
    """Return how a loop is found to hang that gives no sign of life, and after how many periods.

    Args:
        spans: one after the other, each for as long as the process is in that state; of it the
            share that it has run, and that it has waited. The last one lasts.
    """
    loop = LoopWatch(0.0)
    loop.sign(PERIOD_S, 0.0)
    while (at_s := loop.look_s) < until_s:
        ran_s, waited_s, left_s = 1.0, 1.0, at_s
        for letter, *shares in spans:
            state = letter
            for_s = left_s if len(shares) == 2 else min(left_s, shares[2])
            ran_s, waited_s, left_s = (
                ran_s + shares[0] * for_s, waited_s + shares[1] * for_s, left_s - for_s)
            if left_s <= 0:
                break
        if how := loop.look(at_s, Usage(state, ran_s, waited_s)):
            return how, pytest.approx(at_s / PERIOD_S)
    return "", None


@pytest.mark.parametrize(("spans", "how", "periods"), **table({
    "it sleeps all the time": ([(S, 0.0, 0.0)], "it sleeps", 3.25),
    "it is stopped": ([(T, 0.0, 0.0)], "it sleeps", 3.25),
    "it runs a little and sleeps: its messages are lost": ([(S, 0.05, 0.0)], "", None),
    "it does nothing but run": ([(R, 1.0, 0.0)], "it spins", 3.75),
    "one long turn is not enough": (
        [(R, 1.0, 0.0, 3.4 * PERIOD_S), (S, 0.05, 0.0)], "", None),
    "it runs and sleeps, and is always seen running": ([(R, 0.5, 0.0)], "", None),
    "it waits for a processor, and the kernel counts later": ([(R, 0.0, 0.0)], "", None),
    "it waits for a processor": ([(R, 0.0, 1.0)], "", None),
    "it spins with half a processor, and is found out when it has run for long enough": (
        [(R, 0.5, 0.5)], "it spins", 5.25),
    "it waits for a disk": ([(D, 0.0, 0.0)], "", None),
    "it has ended, which others tell": ([(X, 0.0, 0.0)], "", None),
    "it works, and sleeps for ever from then on": (
        [(S, 0.05, 0.0, 3 * PERIOD_S), (S, 0.0, 0.0)], "it sleeps", 4.75),
}))
def test_what_it_did_between_two_looks_tells_whether_it_hangs(spans, how, periods):
    assert found(*spans) == (how, periods and pytest.approx(periods))


@pytest.mark.parametrize("phase", [0.0, 0.1, 0.3, 0.5, 0.7, 0.9, 0.99])
def test_a_loop_that_turns_is_not_taken_for_one_that_sleeps_whenever_it_is_looked_at(phase):
    loop = LoopWatch(0.0)
    loop.sign(PERIOD_S, 0.0)
    while (at_s := loop.look_s) < 1.0:
        turns = int(at_s / PERIOD_S + phase)  # it sleeps, but for a moment in each period
        assert not loop.look(at_s, Usage("S", 1.0 + 0.0005 * turns, 0.0))


def test_where_the_kernel_keeps_no_figures_nothing_is_proved():
    loop = LoopWatch(0.0)
    loop.sign(PERIOD_S, 0.0)
    assert not any(loop.look(loop.look_s, AT_LEISURE) for _ in range(10))


def used(state: str) -> Usage:
    return Usage(state, 1.0, 1.0)


def test_it_is_looked_at_when_two_signs_are_missing_and_hangs_when_three_are():
    loop = LoopWatch(0.0)
    loop.sign(PERIOD_S, 5.0)
    assert loop.look_s == pytest.approx(5.04)
    loop.look(5.04, used("S"))
    assert loop.look_s == pytest.approx(5.065)
    assert loop.look(5.065, used("S"))


def test_a_sign_of_life_begins_anew():
    loop = LoopWatch(0.0)
    loop.sign(PERIOD_S, 0.0)
    loop.look(0.04, used("S"))
    loop.sign(PERIOD_S, 0.05)
    assert loop.look(loop.look_s, used("S")) == ""


def test_of_two_topics_the_more_frequent_is_waited_for():
    loop = LoopWatch(0.0)
    loop.sign(0.05, 1.0)
    loop.sign(PERIOD_S, 1.0)
    loop.sign(0.05, 1.03)
    assert loop.look_s == pytest.approx(1.04)


def test_what_comes_a_hundred_times_a_second_is_waited_for_like_fifty():
    loop = LoopWatch(0.02)
    loop.sign(0.01, 0.0)
    assert loop.look_s == pytest.approx(0.04)


def test_two_looks_that_follow_too_soon_prove_nothing():
    loop = LoopWatch(0.0)
    loop.sign(PERIOD_S, 0.0)
    assert [loop.look(at_s, used("S")) for at_s in (0.04, 0.06, 0.066)] == ["", "", "it sleeps"]


# -- the watchdog ---------------------------------------------------------------------------------


class Machine:
    """What a process has used, as a test says: it works, sleeps, spins, or waits from a time on."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.since_s, self.how = 0.0, "works"

    def used(self, pid: int) -> Usage:
        assert pid == 77
        for_s = self.now_s - self.since_s
        match self.how:
            case "works":
                return Usage("S", 1 + 0.1 * self.now_s, 0.0)
            case "sleeps":
                return Usage("S", 1 + 0.1 * self.since_s, 0.0)
            case "spins":
                return Usage("R", 1 + 0.1 * self.since_s + for_s, 0.0)
        return Usage("R", 1 + 0.1 * self.since_s, for_s)  # it waits


def silent_since_1s(how: str, timeout_s: float = 0.4) -> tuple[float | None, str]:
    """Return how long after a node has fallen silent that is detected, and the reason."""
    machine = Machine()
    core = WatchdogCore(["a"], timeout_s, 0.0, 5.0, used=machine.used)
    for step in range(51):
        machine.now_s = 0.02 * step
        wake(core, machine.now_s - 1e-6)
        if step % 5 == 0:
            core.beat("a", 1, machine.now_s, machine.now_s, 77)
        core.sign("a", 1, PERIOD_S, machine.now_s)
    machine.since_s, machine.how = 1.0, how
    while core.due_s < 4.0 and not core.active:
        machine.now_s = core.due_s
        core.expire(core.due_s)
    return (machine.now_s - 1.0 if core.active else None), core.reason


@pytest.mark.parametrize(("how", "after_s", "reason"), [
    ("sleeps", 0.065, "a: its loop hangs, it sleeps"),
    ("spins", 0.075, "a: its loop hangs, it spins"),
    ("works", 0.4, "a: no heartbeat for 0.4 s"),
    ("waits", 0.8, "a: no heartbeat for 0.4 s")])
def test_a_hang_is_found_by_missing_signs_of_life_and_the_rest_by_the_heartbeat(
        how, after_s, reason):
    found_s, why = silent_since_1s(how)
    assert (found_s, why) == (pytest.approx(after_s, abs=1e-3), reason)


def test_who_only_waits_for_a_processor_has_twice_the_time_and_no_more():
    waited_s, _ = silent_since_1s("waits")
    assert waited_s == pytest.approx(2 * 0.4)


def test_a_sign_of_life_of_an_older_process_or_before_the_first_heartbeat_is_none():
    core = WatchdogCore(["a"], 0.4, 0.0, 5.0)
    core.sign("a", 1, PERIOD_S, 0.1)
    assert core.due_s == 5.0
    core.beat("a", 2, 0.2, 0.2, 77)
    core.sign("a", 1, PERIOD_S, 0.2)
    assert core.due_s == pytest.approx(0.4)
    core.sign("a", 2, PERIOD_S, 0.2)
    assert core.due_s == pytest.approx(0.24)


def test_a_heartbeat_from_before_the_hang_does_not_end_it():
    machine = Machine()
    core = WatchdogCore(["a"], 0.4, 0.0, 5.0, used=machine.used)
    core.beat("a", 1, 1.0, 1.0, 77)
    core.sign("a", 1, PERIOD_S, 1.02)
    machine.how = "sleeps"
    wake(core, 1.2)
    assert core.nodes == ("a#1",), "who respawns it heard it a moment ago, and is to believe this"
    core.beat("a", 1, 1.01, 1.21, 77)
    assert core.active
    core.beat("a", 1, 1.22, 1.22, 77)
    assert not core.active

    wake(core, 1.23)
    core.sign("a", 1, PERIOD_S, 1.24)
    wake(core, 1.4)
    core.peer("a", 1, False, 1.41)
    assert core.nodes == ("a#1",), "that it was killed for it is no news"
    core.peer("a", 2, True, 1.42)
    assert core.nodes == ("a#1",), "the next one is not accused"
    core.peer("a", 2, False, 1.43)
    assert core.nodes == ("a",)
