"""The judge, by timelines of ground truth."""

from __future__ import annotations

import math

import pytest

from rampart.actors.osmosis.airport.model import MissionGoal
from rampart.actors.osmosis.messages import GroundTruth, Pose, Twist
from rampart.sim.osmosis.trial.record import Judge

# Three points along x: taxi to 10, lights to 20, taxi to 30.
GOALS = (MissionGoal(10, 0, "taxi"), MissionGoal(20, 0, "light verification"),
         MissionGoal(30, 0, "taxi"))
MODES = {"T": "taxi", "L": "light verification", "-": ""}


def sample(time_s, x_m, mode="T", *, collisions=0, prohibited_s=0.0, obstacle_m=9.0, edge_m=2.0):
    truth = GroundTruth(Pose(x_m, 0.0, 0.0), Twist(0.0, 0.0), collisions, prohibited_s, obstacle_m,
                        edge_m, 1.0)
    return truth, MODES[mode], time_s


def judged(timeline: str):
    """One character a second is the mode reported while the robot drives on along x."""
    judge = Judge(GOALS)
    for second, mode in enumerate(timeline):
        judge.see(*sample(second, second, mode))
    return judge


def test_every_point_in_order_and_mode_is_a_success():
    #         0         10        20        30
    judge = judged("TTTTTTTTTTLLLLLLLLLLTTTTTTTTTTT")
    found = judge.verdict()
    assert (found.success, found.safe, found.reasons) == (True, True, ())
    assert judge.visit_times_s == [9.0, 19.0, 29.0]
    assert judge.point_m == math.inf


@pytest.mark.parametrize(("timeline", "visited", "reason"), [
        ("T" * 9, 0, "point 1 of 3 at (10, 0) was not reached, nearest 2.00 m"),
        ("-" * 31, 0, "point 1 of 3 at (10, 0) was not reached, nearest 0.00 m"),
        ("TTTTTTTTTTTTTTTTTTTTTTTTTTTTTTT", 1,
         "point 2 of 3 at (20, 0) was passed in mode 'taxi', not in 'light verification'"),
        ("LLLLLLLLLLLLLLLLLLLLTTTTTTTTTTT", 0,
         "point 1 of 3 at (10, 0) was passed in mode 'light verification', not in 'taxi'")])
def test_a_point_not_reached_or_reached_in_the_wrong_mode_is_a_failure(timeline, visited, reason):
    judge = judged(timeline)
    found = judge.verdict()
    assert (found.success, found.safe, found.reasons) == (False, True, (reason,))
    assert len(judge.visit_times_s) == visited


def test_a_collision_makes_unsafe_from_then_on_but_the_mission_may_succeed():
    judge = Judge(GOALS[:1])
    judge.see(*sample(0, 0))
    judge.see(*sample(1, 5, collisions=1))
    judge.see(*sample(2, 10, collisions=1))
    found = judge.verdict()
    assert (found.success, found.safe, judge.first_unsafe_s) == (True, False, 1)
    assert found.reasons == ("1 collision",)
    judge = Judge(GOALS[:1])
    judge.see(*sample(0, 10, prohibited_s=0.02))
    assert judge.verdict().reasons == ("0.02 s in the prohibited area",)
    assert not judge.verdict().safe


def test_the_closest_approaches_are_kept():
    judge = Judge(GOALS[:1])
    for second, (obstacle_m, edge_m) in enumerate([(3, 2), (0.4, 1.5), (5, 0.9)]):
        judge.see(*sample(second, second, obstacle_m=obstacle_m, edge_m=edge_m))
    assert (judge.obstacle_m, judge.prohibited_m, judge.narrowest_s) == (0.4, 0.9, 1)
    assert judge.point_m == 8


def test_without_ground_truth_nobody_knows_whether_it_was_safe():
    found = Judge(GOALS).verdict()
    assert (found.success, found.safe) == (False, None)
    assert found.reasons == ("no ground truth was received: the robot's position is unknown",)
