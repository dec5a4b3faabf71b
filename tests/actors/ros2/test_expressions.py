"""Expressions: what is read of a message."""

import math
from types import SimpleNamespace

import pytest

from rampart.actors.ros2.translation.expressions import Expression, Plane, Quaternion, yaw

PLANE = Plane((43.635, 1.368))
MESSAGE = SimpleNamespace(
    pose=SimpleNamespace(orientation=Quaternion(0.0, 0.0, math.sin(0.4), math.cos(0.4))),
    axes=[0.1, -0.2, math.nan], empty=[], angle=90.0, yaw_rad=0.8, below=-4.0, square=9.0,
    latitude=43.636, longitude=1.37)


@pytest.mark.parametrize(("text", "value"), [
    ("angle", 90.0), ("angle * 0.5", 45.0), ("axes[1]", -0.2), ("axes[-3]", 0.1),
    ("yaw(pose.orientation)", 0.8), ("least( axes )", -0.2),
    ("count(axes)", 3), ("sqrt(square)", 3.0), ("'base_link'", "base_link"), ("''", ""),
    ("quaternion(yaw_rad)", MESSAGE.pose.orientation),
    ("north(latitude, longitude)", 111.105), ("east(latitude, longitude)", 161.393)])
def test_what_is_read(text, value):
    read = Expression(text, PLANE).read(MESSAGE)
    assert read == (value if isinstance(value, str) else pytest.approx(value, abs=1e-3))


@pytest.mark.parametrize("text", ["sqrt(below)", "least(empty)"])
def test_what_is_no_number_is_none(text):
    assert math.isnan(Expression(text).read(MESSAGE))


@pytest.mark.parametrize("x", [0.0, 0.7, 2.0])
def test_what_is_no_rotation_has_no_heading(x):
    assert math.isnan(yaw(Quaternion(x, 0.0, 0.0, 0.0))) is (x != 1.0)


@pytest.mark.parametrize(("text", "why"), [
    ("", "expected a field"), ("angle * x", "expected a number"),
    ("jaw(pose)", "no function 'jaw'; known: yaw, quaternion, sqrt"),
    ("yaw(a, b)", "yaw takes 1 field"), ("east(latitude)", "east takes 2 fields"),
    ("pose..x", "is not a field"), ("axes[x]", "is not a field"), ("a b", "expected a field"),
    ("yaw(axes[one])", "'axes[one]' is not a field")])
def test_what_makes_no_sense_is_one_line(text, why):
    with pytest.raises(ValueError, match=r"[^\n]+") as raised:
        Expression(text, PLANE)
    assert why in str(raised.value)
    assert "\n" not in str(raised.value)


def test_the_globe_needs_a_datum():
    with pytest.raises(ValueError, match="needs a datum"):
        Expression("east(latitude, longitude)")


def test_an_item_that_is_not_there_is_an_error():
    with pytest.raises(ValueError, match=r"axes\[7\]: the list has 3 items"):
        Expression("axes[7]").read(MESSAGE)
