"""`virtual_run`: a whole system for tests of one's own."""

import pytest

from rampart.testing import virtual_run
from tests import CELL


def test_a_system_runs_with_its_faults_as_long_as_it_is_told():
    done = virtual_run(CELL, "kill:gripper@1", seconds=3.0, seed=4)
    assert done.record.restarts["gripper"] == 1
    assert done.failures == ()
    assert done.trace == virtual_run(CELL, "kill:gripper@1", seconds=3.0, seed=4).trace


def test_a_system_without_an_end_has_to_be_told_when():
    with pytest.raises(ValueError, match=r"cell\.toml: has no \[end\]"):
        virtual_run(CELL)
