"""An observer that did not run draws no conclusion from that time."""

from __future__ import annotations

import pytest

from rampart.actors.machine.absence import ABSENT_S, GRACE_S, Absence


def test_an_observer_that_runs_is_never_excused():
    absence = Absence(0.0)
    assert [absence.note(0.2 * n) for n in range(1, 50)] == [0.0] * 49
    assert not absence.excuses(9.8)


def test_one_that_was_stopped_is_excused_for_a_grace_that_covers_the_others():
    absence = Absence(1.0)
    assert absence.note(31.0) == pytest.approx(30.0)
    assert absence.excuses(31.0)
    assert absence.excuses(31.0 + 0.9 * GRACE_S)
    assert not absence.excuses(31.0 + GRACE_S)


def test_one_that_is_always_late_is_not_always_excused():
    absence, now_s, excused = Absence(0.0), 0.0, 0
    for _ in range(100):
        now_s += ABSENT_S + 0.05
        absence.note(now_s)
        excused += absence.excuses(now_s)
    assert 0 < excused < 50


def test_the_grace_is_in_real_seconds_on_a_clock_that_is_faster():
    absence = Absence(0.0, rate=4.0)
    absence.note(30.0)
    assert absence.excuses(30.0 + 3.9 * GRACE_S)
    assert not absence.excuses(30.0 + 4.0 * GRACE_S)
