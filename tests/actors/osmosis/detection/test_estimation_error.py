"""DM8: a wrong localization is detected; faults of other sources do not count as its own."""

from __future__ import annotations

import math

import pytest

from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis.detection.area.estimation_error import EstimationMonitor
from tests.actors.osmosis.control.localization_drive import (
    END_S,
    Accused,
    Truth,
    disturbed,
    drive,
    honest,
    watch,
)

FROM_S = 4.0


def accusations(lie=honest, to_s=END_S, monitor=None) -> list[tuple[float, float]]:
    accused = Accused(lie, monitor or EstimationMonitor(-math.inf))
    watch(disturbed([]), accused, to_s=to_s)
    return accused.spans


def lying(x_m=0.0, y_m=0.0, yaw_rad=0.0, *, per_s=False, to_s=math.inf):
    def lie(truth: Truth, now_s: float) -> m.Pose:
        share = 0.0
        if FROM_S <= now_s < to_s:
            share = now_s - FROM_S if per_s else 1.0
        return m.Pose(truth.x_m + share * x_m, truth.y_m + share * y_m,
                      truth.yaw_rad + share * yaw_rad)

    return lie


def test_a_localization_that_is_silent_is_not_accused():
    assert accusations(lambda t, now_s: honest(t, now_s) if now_s < FROM_S else None) == []


@pytest.mark.parametrize(("lie", "within_s"), [
    pytest.param(lying(0.7, 0.7), 0.25, id="a metre aside"),
    pytest.param(lying(0.0, 0.25, per_s=True), 1.6, id="prohibited-area: drifting north"),
    pytest.param(lying(-0.1, 0.1, per_s=True), 2.6, id="drifting slowly"),
    pytest.param(lying(0.0, 0.0, 0.5), 0.8, id="turned on the spot"),
    pytest.param(lying(2.0, 0.0, 1.0), 0.25, id="wrong in all"),
])
def test_a_lie_is_found_out_in_time_and_forgiven_when_it_ends(lie, within_s):
    ((since_s, until_s),) = accusations(lie)
    assert FROM_S < since_s <= FROM_S + within_s
    assert until_s == math.inf
    ((_, until_s),) = accusations(lying(0.7, 0.7, to_s=8.0), 9.0)
    assert 8.0 < until_s <= 8.6, "forgiven within half a second of honesty"


def test_a_pose_that_is_stuck_with_fresh_stamps_is_found_out_within_half_a_metre():
    kept: list[m.Pose] = []

    def stuck(truth: Truth, now_s: float) -> m.Pose:
        if now_s < FROM_S:
            return honest(truth, now_s)
        kept.append(honest(truth, now_s))
        return kept[0]

    (since_s, _), *_ = accusations(stuck, FROM_S + 3.0)
    truth = next(t for t in drive() if isinstance(t, Truth) and t.stamp_s >= since_s)
    assert math.dist((truth.x_m, truth.y_m), (kept[0].x_m, kept[0].y_m)) < 0.55


def test_a_respawned_module_claims_nothing_before_it_has_compared_or_waited():
    monitor = EstimationMonitor(1.0)
    assert (monitor.known, monitor.due_s) == (False, 1.0)
    for x_m, stamp_s in ((0.0, 1e9), (0.0, math.nan), (math.nan, 0.0), (math.inf, 0.0)):
        monitor.pose(m.Pose(x_m, 0.0, 0.0), stamp_s, 0.0, "localization#1")
    monitor.expire(0.5)
    assert not monitor.known
    accusations(to_s=0.3, monitor=monitor)  # what cannot be does not hide what comes after it
    assert monitor.known
    waiting = EstimationMonitor(1.0)
    waiting.expire(1.0)
    assert (waiting.known, waiting.active) == (True, False)
