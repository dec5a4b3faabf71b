"""What a launcher that was stopped excuses, without a process; the rest is in tests/whole."""

from __future__ import annotations

import pytest

from rampart.actors.osmosis.messages import Twist
from rampart.sim.osmosis.trial.mission_trial import WORLD_LATE_S, RunEnd
from rampart.sim.runs.process_run import _RELINK_S, excused_s


@pytest.mark.parametrize("late_s", [-0.01, 0.0, 0.4])
def test_a_loaded_machine_excuses_nothing(late_s):
    assert excused_s(late_s) == 0.0


@pytest.mark.parametrize("rate", [0.5, 1.0, 4.0])
def test_a_launcher_that_was_stopped_dials_its_partners_again_before_the_world_counts_as_gone(rate):
    end = RunEnd(patience_s=60.0, waits=True)
    end.truth(Twist(0.0, 0.0), 10.0)
    awake_s = 10.0 + 7.0 * rate  # stopped for seven seconds of wall time
    end.excuse(excused_s(7.0) * rate)
    relinked_s = awake_s + _RELINK_S * rate
    assert end.world_gone(relinked_s) == ""
    assert "the world is gone" in end.world_gone(relinked_s + WORLD_LATE_S + 0.1)
