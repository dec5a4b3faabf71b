"""A machine without processor time for a while; `make overload` drives many, and for longer."""

from __future__ import annotations

import pytest

from tests.whole.overload import LOADS, drive


@pytest.mark.slow
@pytest.mark.processes
@pytest.mark.alone
@pytest.mark.timeout(400)
@pytest.mark.parametrize("kind", LOADS)
def test_the_mission_goes_on_after_an_overload(tmp_path, kind):
    found, story = drive(tmp_path, kind, 15.0)
    assert (found.mission, found.safety) == ("success", "safe"), story
