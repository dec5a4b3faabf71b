"""A machine without processor time for a while; `make overload` drives many, and for longer."""

from __future__ import annotations

import pytest

from tests.whole.overload import LOADS, drive
from tests.whole.overload_runs import Outcome, row


@pytest.mark.slow
@pytest.mark.processes
@pytest.mark.alone
@pytest.mark.timeout(400)
@pytest.mark.parametrize("kind", LOADS)
def test_the_mission_goes_on_after_an_overload(tmp_path, kind):
    found, story = drive(tmp_path, kind, 15.0)
    assert (found.mission, found.safety) == ("success", "safe"), story


def test_the_row_of_a_kind_counts_what_became_of_it():
    good = Outcome("success", "safe", 2, True, 1, 0.25, 60.0, ())
    bad = good._replace(mission="fail", decisions=8, restarts=4, late_s=1.5)
    assert row("busy", [good, good, bad]) == (
        "| busy | 2 of 3 | 3 of 3 | 3 | 2 (8) | 1 (4) | 1.50 s |")
