"""An observer that did not run draws no conclusion from that time."""

from __future__ import annotations

import pytest

from rampart.actors.machine.absence import ABSENT_S, GRACE_S, Absence


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
