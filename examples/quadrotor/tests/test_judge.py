"""The judge, on truths that are made up."""

import math

import msgspec
import pytest
from quadrotor import topics as t
from quadrotor.judge import FlightJudge

from rampart import Header

WAYPOINTS = ((5.0, 0.0, 5.0), (0.0, 0.0, 5.0))
ROUND = [(0.0, 0.0, 0.0), (0.0, 0.0, 5.0), (5.0, 0.0, 5.0), (0.0, 0.0, 5.0), (0.0, 0.0, 2.0)]


def truth(x_m=0.0, y_m=0.0, z_m=5.0, **more):
    said = {"speed_mps": 0.0, "tilt_rad": 0.0, "grounded": z_m < 0.01, "turning": True,
            "touch_speed_mps": 0.5, "touch_tilt_rad": 0.0, "highest_tilt_rad": 0.3, **more}
    return t.Truth(x_m, y_m, z_m, **said)


def judged(*truths):
    judge = FlightJudge(FlightJudge.Parameters(waypoints=WAYPOINTS))
    for i, said in enumerate(truths):
        judge.truth(said, Header("world", 1, i + 1, float(i)))
    return judge


def flown(*, at=(0.0, 0.0), places=ROUND):
    stands = [truth(*at, 0.0, turning=False)] * 4
    return [*(truth(*place) for place in places), *stands]


def test_a_round_in_order_with_a_landing_at_home_is_a_success():
    judge = judged(*flown())
    assert judge.over(9.0) == "it stands on the ground"
    verdict = judge.verdict()
    assert verdict.success
    assert verdict.safe
    assert verdict.reasons == ()
    assert verdict.margins == {"fence_m": 35.0, "ceiling_m": 20.0}


@pytest.mark.parametrize(("truths", "reason"), [
    (flown(places=[*ROUND[:2], *ROUND[3:]]), "waypoint 1 was not reached"),
    (flown(places=ROUND[:3]), "waypoint 2 was not reached"),
    (flown(at=(3.0, 0.0)), "did not land at home"),
    ([truth(*place) for place in ROUND], "did not land")])
def test_what_is_missing_is_named(truths, reason):
    verdict = judged(*truths).verdict()
    assert not verdict.success
    assert verdict.safe
    assert verdict.reasons == (reason,)


@pytest.mark.parametrize(("wrong", "reason"), [
    ({"touch_speed_mps": 1.6}, "touched the ground too fast"),
    ({"touch_tilt_rad": 0.5}, "touched the ground tilted"),
    ({"highest_tilt_rad": 1.3}, "tilted too far"),
    ({"x_m": -41.0}, "outside of the geofence"), ({"z_m": 26.0}, "too high"),
    ({"z_m": math.nan}, "too high")])
def test_each_limit_makes_a_flight_unsafe_from_when_it_is_passed(wrong, reason):
    verdict = judged(*flown()[:5], truth(**wrong), *flown()[5:]).verdict()
    assert verdict.safe is False
    assert not verdict.success
    assert reason in verdict.reasons
    assert verdict.unsafe_s == 5.0


def test_of_whom_nothing_is_heard_nothing_is_known():
    assert judged().verdict().safe is None


@pytest.mark.parametrize("wrong", [
    {"waypoints": []}, {"waypoints": [[0, 0, -1]]}, {"fence_m": 0}, {"height_m": 3}, {}])
def test_parameters_that_make_no_sense_are_refused(wrong):
    given = {"waypoints": [[0, 0, 1]], **wrong} if wrong else {}
    with pytest.raises(msgspec.ValidationError):
        msgspec.convert(given, FlightJudge.Parameters)
