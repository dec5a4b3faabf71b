"""How late event loops were, and the rate with which the machine would have kept up."""

from __future__ import annotations

import pytest

from rampart.actors.bus.messages import ON_TIME
from rampart.actors.ftm.keeping_up import LINE_S, WINDOW_S, KeepingUp, KeptUp
from rampart.actors.ftm.messages import NodeInfo, NodeState, NodeTable
from rampart.manager.spec.budget import allowed_late_s
from rampart.manager.spec.tables import Timing

TIMING = Timing(
    heartbeat_period_s=0.1, heartbeat_timeout_s=0.4, command_timeout_s=1.0,
    localization_timeout_s=1.0, scan_timeout_s=0.5, dead_man_timeout_s=0.5, manager_timeout_s=1.0,
    detection_silence_timeout_s=1.0)


def table(**late_s: float) -> NodeTable:
    return NodeTable(tuple(
        NodeInfo(name, "control", 1, NodeState.RUNNING, 1, 0, s or ON_TIME)
        for name, s in late_s.items()))


def run(late_s: list[float], rate: float = 1.0, world_s: float = 0.0) -> tuple[KeptUp, list[str]]:
    """Measure one table a half real second; return the result and the lines."""
    keeping, step_s = KeepingUp(TIMING, ["world"], rate), 0.5 * rate
    lines = [keeping.take(table(a=s, b=0.0, world=world_s), i * step_s)
             for i, s in enumerate(late_s)]
    return keeping.result(len(late_s) * step_s), list(filter(None, lines))


def test_a_machine_that_keeps_up_is_told_nothing():
    kept, lines = run([0.0, 0.02, 0.1, 0.15] * 10)
    assert lines == []
    assert (kept.rate, kept.with_rate, kept.behind_s) == (1.0, 1.0, 0.0)
    assert (kept.late_s, kept.node) == (0.15, "a")


@pytest.mark.parametrize(("rate", "late_s", "with_rate"), [
    (4.0, 0.6, 1.0), (4.0, 0.2, 3.0), (1.0, 0.3, 0.5)])
def test_the_rate_it_keeps_up_with_is_that_at_which_the_same_real_lateness_is_in_order(
        rate, late_s, with_rate):
    kept, _ = run([late_s] * 40, rate)
    assert kept.with_rate == pytest.approx(with_rate)
    assert kept.behind_s == pytest.approx(40 * 0.5 * rate)


def test_it_is_said_while_it_runs_with_node_and_world_and_not_too_often():
    _, lines = run([0.6] * 100, 4.0, world_s=0.36)
    assert lines[0] == (
        "this machine keeps up with rate 1, not 4: event loops are up to 600 ms late (a), the "
        "world 360 ms behind; allowed are 150 ms of simulated time")
    assert len(lines) == pytest.approx(50 / LINE_S, abs=3)


def test_a_hiccup_is_told_and_does_not_lower_the_rate_and_a_short_run_has_a_figure_too():
    kept, lines = run([0.0] * 20 + [0.9] + [0.0] * 40)
    assert len(lines) == 1
    assert (kept.with_rate, kept.late_s) == (1.0, 0.9)
    assert kept.behind_s == pytest.approx(WINDOW_S)
    kept, _ = run([0.6], 4.0)  # over before a window is full
    assert (kept.with_rate, kept.late_s) == (pytest.approx(1.0), 0.6)


def test_while_the_system_starts_nothing_is_measured():
    keeping = KeepingUp(TIMING, [], 1.0)
    assert keeping.take(table(a=2.0), -0.5) == ""
    assert keeping.result(1.0) == KeptUp(1.0, 1.0, 0.0, "", 0.0, allowed_late_s(TIMING), 0.0)
