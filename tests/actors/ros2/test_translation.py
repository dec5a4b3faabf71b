"""Messages of ROS 2 and of the system, each made of the other; definitions; what is refused."""

from __future__ import annotations

import math
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest

from rampart.actors.bus.bounds import Floats32
from rampart.actors.bus.messages import Message
from rampart.actors.bus.topic import Qos
from rampart.actors.ros2.translation.expressions import Expression, Plane, Quaternion, yaw
from rampart.actors.ros2.translation.forms import READY, WRITTEN
from rampart.actors.ros2.translation.mapping import (
    Inward,
    NotMeantError,
    Outward,
    message_of,
    topic_of,
)
from rampart.actors.ros2.translation.tables import Ros2Link
from rampart.actors.ros2.translation.types import DISTRIBUTIONS, Types

JAZZY = Types("jazzy")
ODOMETRY, SCAN = "nav_msgs/msg/Odometry", "sensor_msgs/msg/LaserScan"
TWIST, JOY = "geometry_msgs/msg/Twist", "sensor_msgs/msg/Joy"
TF = "tf2_msgs/msg/TFMessage"


class Pose(Message, frozen=True):
    x_m: float
    y_m: float
    yaw_rad: float


class Twist(Message, frozen=True):
    linear_mps: float
    angular_radps: float


class Odometry(Message, frozen=True):
    pose: Pose
    twist: Twist


class Sweep(Message, frozen=True):
    ranges_f32: Floats32
    range_max_m: float
    who: str = "laser"


def heard(kind, made, **said):
    return Inward(Ros2Link(type=kind, subscribe="/x", to="x", **said), JAZZY, made)


def said(kind, made, **more):
    return Outward(Ros2Link(type=kind, publish="/x", from_="x", **more), JAZZY, made)


def odometry(yaw_rad=0.5):
    message = JAZZY.blank(ODOMETRY)
    message.header.stamp.sec, message.header.stamp.nanosec = 12, 5
    message.header.frame_id = "odom"
    message.pose.pose.position.x, message.pose.pose.position.y = 1.0, 2.0
    message.pose.pose.orientation.z = math.sin(yaw_rad / 2)
    message.pose.pose.orientation.w = math.cos(yaw_rad / 2)
    message.twist.twist.linear.x, message.twist.twist.angular.z = 0.3, -0.1
    return message


def test_a_ready_form_fills_a_robot_s_own_message_and_comes_back_as_it_went():
    made, stamp_ns = heard(ODOMETRY, Odometry)(odometry())
    assert made == Odometry(Pose(1.0, 2.0, pytest.approx(0.5)), Twist(0.3, -0.1))
    assert stamp_ns == 12_000_000_005
    first = Odometry(Pose(1.0, -2.0, -3.0), Twist(0.3, 0.2))
    there = said(ODOMETRY, Odometry, frame="odom", child="base_link")(first, 7_000_000_001)
    message = JAZZY.decode(ODOMETRY, there)
    assert (message.header.frame_id, message.child_frame_id) == ("odom", "base_link")
    back, stamp_ns = heard(ODOMETRY, Odometry, frame="odom")(message)
    assert stamp_ns == 7_000_000_001
    assert back.pose.yaw_rad == pytest.approx(-3.0)
    assert msgspec.structs.replace(back, pose=first.pose) == first


def test_a_sweep_is_bytes_on_one_side_and_a_list_on_the_other():
    there = JAZZY.decode(SCAN, said(SCAN, Sweep)(
        Sweep(np.array([1, 2.5, math.inf], "<f4").tobytes(), 8.0), 0))
    assert there.ranges.tolist() == [1.0, 2.5, math.inf]
    back, _ = heard(SCAN, Sweep)(there)
    assert np.frombuffer(back.ranges_f32, "<f4").tolist() == [1.0, 2.5, math.inf]
    assert back.who == "laser"


def test_what_is_said_in_the_table_comes_before_the_form_and_may_be_of_a_message_beside_it():
    made, _ = heard(ODOMETRY, Pose, fields={"x_m": "pose.pose.position.y * -0.001", "y_m": 4.0}
                    )(odometry())
    assert made == Pose(-0.002, 4.0, pytest.approx(0.5))
    link = Ros2Link(type=ODOMETRY, subscribe="/x", to="x", beside="y",
                    fields={"x_m": "beside.linear_mps * 2", "y_m": "beside.angular_radps"})
    made, _ = Inward(link, JAZZY, Pose, Twist)(odometry(), Twist(0.25, 0.5))
    assert made == Pose(0.5, 0.5, pytest.approx(0.5))


IMU, POSE = "sensor_msgs/msg/Imu", "geometry_msgs/msg/PoseWithCovarianceStamped"


class Turn(Message, frozen=True):
    yaw_rad: float
    yaw_rate_radps: float = 0.0


def changed(kind, **fields):
    message = JAZZY.blank(kind)
    for path, value in fields.items():
        *way, last = path.split("__")
        inner = message
        for step in way:
            inner = getattr(inner, step)
        setattr(inner, last, value)
    return message


@pytest.mark.parametrize(("kind", "made", "fields", "words"), [
    (IMU, Turn, {"orientation__w": 0.0}, ("yaw_rad", "orientation = (x 0, y 0, z 0, w 0)")),
    (IMU, Turn, {"orientation__w": math.sqrt(2)}, ("yaw_rad", "w 1.41421")),
    (IMU, Turn, {"orientation__z": math.nan}, ("yaw_rad", "z nan")),
    (IMU, Turn, {"angular_velocity__z": math.nan}, ("yaw_rate_radps", "velocity.z = nan")),
    (IMU, Turn, {"orientation_covariance": np.full(9, -1.0)},
     ("yaw_rad", "unknown", "orientation_covariance[0] = -1")),
    (IMU, Turn, {"angular_velocity_covariance": np.full(9, -1.0)},
     ("yaw_rate_radps", "angular_velocity_covariance[0] = -1")),
    (POSE, None, {"pose__covariance": np.full(36, -1.0)},
     ("position_sd_m", "pose.covariance[0] = -1")),
    (ODOMETRY, None, {"pose__pose__position__x": math.inf}, ("x_m", "position.x = inf")),
    (SCAN, None, {"ranges": np.full(3, math.nan, "f4")}, ("nearest_m", "least(ranges)")),
    ("sensor_msgs/msg/Temperature", None, {"temperature": math.nan}, ("temperature = nan",))])
def test_a_value_that_means_nothing_is_refused_with_its_field_and_what_it_is(
        kind, made, fields, words):
    link = Ros2Link(type=kind, subscribe="/x", to="x")
    inward = Inward(link, JAZZY, made or message_of(link, JAZZY))
    with pytest.raises(ValueError, match=r"^[^\n]+\Z") as raised:
        inward(changed(kind, **fields))
    assert all(word in str(raised.value) for word in words), str(raised.value)


@pytest.mark.parametrize(("kind", "fields", "unknown"), [
    (IMU, {"orientation_covariance": np.full(9, -1.0), "orientation__w": 0.0}, {"yaw_rad"}),
    (IMU, {"linear_acceleration_covariance": np.full(9, -1.0)}, {"accel_x_mps2", "accel_y_mps2"}),
    ("sensor_msgs/msg/NavSatFix", {"position_covariance_type": 0}, {"accuracy_m"}),
    ("sensor_msgs/msg/BatteryState", {"current": math.nan, "percentage": math.nan},
     {"current_a", "charge"})])
def test_what_a_sensor_says_it_does_not_know_is_none_and_the_rest_passes(kind, fields, unknown):
    link = Ros2Link(type=kind, subscribe="/x", to="x")
    made, _ = Inward(link, JAZZY, message_of(link, JAZZY))(changed(kind, **fields))
    assert {name for name in made.__struct_fields__ if getattr(made, name) is None} == unknown


def test_fields_of_a_topic_that_no_class_declares_have_the_types_of_what_they_read():
    kinds = {"buttons_count": ("count(buttons)", int), "what": ("'a joystick'", str),
             "is_there": (True, bool), "frame": ("header.frame_id", str),
             "turn": ("axes[0] * 2", float)}
    link = Ros2Link(type="sensor_msgs/msg/JoyFeedbackArray", subscribe="/x", to="x",
                    fields={"count": "count(array)"})
    assert message_of(link, JAZZY)(count=2).count == 2
    made = message_of(msgspec.structs.replace(link, type=JOY, fields={
        name: said for name, (said, _) in kinds.items()}), JAZZY)
    found = {field.name: field.type for field in msgspec.structs.fields(made)}
    assert {name: getattr(found[name], "__origin__", found[name]) for name in kinds} == {
        name: kind for name, (_, kind) in kinds.items()}
    for name, said_ in (("no name", "axes"), ("stamp", "header.stamp")):
        with pytest.raises(ValueError, match="expected"):
            message_of(msgspec.structs.replace(link, type=JOY, fields={name: said_}), JAZZY)


def test_of_several_publishers_no_message_replaces_another_one_s():
    link = Ros2Link(type="std_msgs/msg/Bool", subscribe="/x", to="x", publishers="any")
    assert topic_of(link, JAZZY).qos is Qos.COMMAND


@pytest.mark.parametrize("kind", sorted(READY))
def test_every_ready_form_can_be_heard_as_it_is_and_what_can_be_written_comes_back(kind):
    frames = {"frame": "map", "child": "odom"} if kind == TF else {}
    link = Ros2Link(type=kind, subscribe="/x", to="x", **frames)
    made = message_of(link, JAZZY)
    assert set(made.__struct_fields__) == set(READY[kind])
    first = msgspec.convert({name: {float: 0.5, bytes: b"\0\0\0\x3f", bool: True, int: 1}[
        kind_of(made, name)] for name in made.__struct_fields__}, made)
    if kind == JOY:  # an item is not written into an empty list
        return
    back, _ = Inward(link, JAZZY, made)(JAZZY.decode(kind, said(kind, made, **frames)(first, 0)))
    for name in WRITTEN[kind]:
        assert getattr(back, name) == pytest.approx(getattr(first, name)), name


def kind_of(made, name):
    field = next(f for f in msgspec.structs.fields(made) if f.name == name)
    kind = float if field.type == float | None else field.type
    return getattr(kind, "__origin__", kind)


WRONG = [
    (lambda: heard(ODOMETRY, Sweep), "ranges_f32 of Sweep has no value"),
    (lambda: heard(ODOMETRY, Pose, fields={"x": "child_frame_id"}), "Pose has no field 'x'"),
    (lambda: heard(ODOMETRY, Pose, fields={"x_m": "pose.position.x"}),
     "geometry_msgs/msg/PoseWithCovariance has no field 'position'; known: pose"),
    (lambda: heard(ODOMETRY, Pose, fields={"x_m": "pose.x.y"}), "no field 'x'"),
    (lambda: heard(ODOMETRY, Pose, fields={"x_m": "child_frame_id[0]"}), "not a list"),
    (lambda: heard("nav_msgs/msg/Odometri", Pose), "'nav_msgs/msg/Odometri' is not known to jazzy"),
    (lambda: heard(TF, Pose), "frame and child are missing"),
    (lambda: said(TF, Pose), "frame and child are missing"),
    (lambda: said(TWIST, Sweep), "no field of geometry_msgs/msg/Twist has a value"),
    (lambda: said(TWIST, Twist, fields={"linear.x": "speed"}), "Twist has no field 'speed'"),
    (lambda: said(TWIST, Twist, fields={"linear": "linear_mps"}), "expected one of its fields"),
    (lambda: said(TWIST, Twist, fields={"linear.w": "linear_mps"}), "has no field 'w'"),
    (lambda: Expression("east(latitude, longitude)"), "needs a datum"),
    (lambda: Expression("axes[7]").read(MESSAGE), "axes[7]: the list has 3 items"),
    *((lambda text=text: Expression(text, PLANE), why) for text, why in (
        ("", "expected a field"), ("angle * x", "expected a number"),
        ("jaw(pose)", "no function 'jaw'; known: yaw, quaternion, sqrt"),
        ("yaw(a, b)", "yaw takes 1 field"), ("east(latitude)", "east takes 2 fields"),
        ("pose..x", "is not a field"), ("axes[x]", "is not a field"), ("a b", "expected a field"),
        ("yaw(axes[one])", "'axes[one]' is not a field"))),
]


@pytest.mark.parametrize(("make", "why"), WRONG)
def test_a_table_or_expression_that_makes_no_sense_is_refused_in_one_line(make, why):
    with pytest.raises(ValueError, match=r"[^\n]+") as raised:
        make()
    assert why in str(raised.value)
    assert "\n" not in str(raised.value)


def test_values_beyond_their_bounds_and_other_frames_are_refused():
    for value in (math.nan, math.inf, -math.inf):  # moves no wheel
        with pytest.raises(ValueError, match="expected a finite number"):
            said(TWIST, Twist)(Twist(value, 0.0), 0)
    transform = JAZZY.decode(TF, said(TF, Pose, frame="map", child="odom")(Pose(1, 2, 0), 5))
    with pytest.raises(NotMeantError):
        heard(TF, Pose, frame="map", child="base_link")(transform)
    with pytest.raises(ValueError, match="its frame is 'odom'; expected 'map'"):
        heard(ODOMETRY, Pose, frame="map")(odometry())
    message = JAZZY.blank(SCAN)
    message.ranges = np.zeros(70_000, "f4")
    with pytest.raises(ValueError, match=r"Expected `?bytes"):
        heard(SCAN, Sweep)(message)


@pytest.mark.parametrize("name", DISTRIBUTIONS)
def test_each_distribution_has_services_and_the_action_of_navigation(name):
    types = Types(name)
    assert "nav2_msgs/action/NavigateToPose" in types.known
    assert "nav2_msgs/action/NavigateToPose_SendGoal" in types.known
    assert "lifecycle_msgs/srv/ChangeState" in types.known
    digest = types.hash("std_srvs/srv/Trigger")
    assert digest == "TypeHashNotSupported" if name == "humble" else digest.startswith("RIHS01_")


def write(folder, name, text):
    file = folder / name
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(text)
    return folder


def test_a_robot_s_own_definitions(tmp_path):
    folder = write(tmp_path, "arm_msgs/msg/Arm.msg",
                   "# an arm\nstd_msgs/Header header\nJoint[] joints\n")
    write(tmp_path, "arm_msgs/msg/Joint.msg", "float64 angle\nstring<=20 name\nuint8[3] rgb\n")
    write(tmp_path, "arm_msgs/srv/Fold.srv", "bool fast\n---\nbool done\n")
    types = Types("jazzy", [folder])
    joint = types.blank("arm_msgs/msg/Joint")
    joint.angle, joint.name = 0.25, "elbow"
    arm = types.blank("arm_msgs/msg/Arm")
    arm.joints = [joint]
    back = types.decode("arm_msgs/msg/Arm", types.encode("arm_msgs/msg/Arm", arm))
    assert (back.joints[0].angle, back.joints[0].name) == (0.25, "elbow")
    assert "arm_msgs/srv/Fold" in types.known
    assert types.hash("arm_msgs/srv/Fold") != types.hash("arm_msgs/msg/Arm")
    link = Ros2Link(type="arm_msgs/msg/Arm", subscribe="/arm", to="arm")
    made, _ = Inward(link, types, message_of(link, types))(back)
    assert made.joints[0].rgb_len == 3


@pytest.mark.parametrize(("name", "text", "why"), [
    ("a/srv/A.srv", "bool x\n", "1 parts; expected 2 with --- between them"),
    ("a/action/A.action", "bool x\n---\n", "2 parts; expected 3"),
    ("a/msg/A.msg", "float64\n", "A.msg"),
    ("A.msg", "float64 x\n", "no package/msg/Name.msg in it")])
def test_definitions_that_make_no_sense_are_refused_in_one_line(tmp_path, name, text, why):
    with pytest.raises(ValueError, match=r"[^\n]+") as raised:
        Types("jazzy", [write(tmp_path, name, text)])
    assert why in str(raised.value)
    assert "\n" not in str(raised.value)


UNUSABLE = [
    ({"a/msg/Wide.msg": "wstring text\n"}, "a/msg/Wide has a wstring"),
    ({"a/msg/Wide.msg": "wstring<=8[] text\n"}, "a/msg/Wide has a wstring"),
    ({"a/msg/Wide.msg": "Inner[2] in\n", "a/msg/Inner.msg": "wstring x\n"},
     "a/msg/Wide: type 'a/msg/Inner' is left out, too"),
    ({"a/msg/Wide.msg": "Missing y\n"}, "a/msg/Wide: type 'a/msg/Missing' is not known"),
    ({"a/msg/Wide.msg": "Wide[] a\n"}, "a/msg/Wide: type 'a/msg/Wide' is left out, too")]


@pytest.mark.parametrize(("files", "why"), UNUSABLE)
def test_a_definition_that_cannot_be_used_is_left_out_with_what_is_made_of_it(tmp_path, files, why):
    for name, text in {**files, "a/msg/Fine.msg": "uint8 a\n",
                       "a/srv/Ask.srv": "Wide what\n---\nFine fine\n"}.items():
        write(tmp_path, name, text)
    types = Types("jazzy", [tmp_path])
    assert types.encode("a/msg/Fine", types.blank("a/msg/Fine")) == b"\0\1\0\0\0"
    assert "a/srv/Ask" not in types.known
    assert types.notes["a/msg/Wide"] == f"left out: {types.left_out['a/msg/Wide']}"
    for use in (types.hash, types.decoder, types.blank, types.fields):
        with pytest.raises(ValueError, match=r"^type 'a/msg/Wide': [^\n]+\Z") as raised:
            use("a/msg/Wide")
        assert why in str(raised.value)


def test_a_definition_of_a_robot_replaces_the_one_that_ships(tmp_path):
    text = "string behavior_tree\n---\nuint16 code\n---\nfloat32 left\n"
    write(tmp_path, "nav2_msgs/action/NavigateToPose.action", text)
    write(tmp_path, "geometry_msgs/msg/Twist.msg", "Vector3 linear\nVector3 angular\n")
    types = Types("jazzy", [tmp_path])
    assert [name for name, _ in types.fields("nav2_msgs/action/NavigateToPose_Result")] == ["code"]
    changed = "nav2_msgs/action/NavigateToPose_GetResult"
    assert types.hash(changed) != JAZZY.hash(changed)
    assert types.hash(TWIST) == JAZZY.hash(TWIST)
    assert set(types.notes) == {f"nav2_msgs/action/NavigateToPose_{part}"
                                for part in ("Goal", "Result", "Feedback")}


@pytest.mark.parametrize("text", ["uint8 a\r\nstring b # c\r\n", "uint8 a\u2028string b\n",
                                  "# \u00e9\u2028uint8 a\n\x0cstring b"])
def test_lines_of_a_definition_end_as_in_ros_2(tmp_path, text):
    for name in ("a/msg/A.msg", "a/srv/A.srv"):
        file = write(tmp_path, name, "") / name
        file.write_bytes((text + "\n---\n" * name.endswith("srv")).encode())
    types = Types("jazzy", [tmp_path])
    for name in ("a/msg/A", "a/srv/A_Request"):
        assert [field for field, _ in types.fields(name)] == ["a", "b"]


AS_RCLPY_SAYS = bytes.fromhex(  # JointState(name=["a"], position=[1.0]), by serialize_message
    "000100000000000000000000010000000000000001000000020000006100000001000000000000000000f03f"
    "0000000000000000ffffffffffffffff")


def test_the_tail_of_a_message_that_was_serialized_beforehand_is_ignored_as_in_ros_2():
    joint = JAZZY.decode("sensor_msgs/msg/JointState", AS_RCLPY_SAYS)
    assert (joint.name, joint.position.tolist(), len(joint.effort)) == (["a"], [1.0], 0)
    with pytest.raises(ValueError, match="JointState"):
        JAZZY.decode("sensor_msgs/msg/JointState", AS_RCLPY_SAYS[:-12])
    with pytest.raises(ValueError, match="begins with 00 07 00 00; expected CDR"):
        JAZZY.decode("sensor_msgs/msg/JointState", b"\0\7" + AS_RCLPY_SAYS[2:])


def test_a_topic_of_any_type_has_the_defaults_of_ros_2_and_is_written_whole():
    names = [name for name in JAZZY.known if "/msg/" in name and name not in READY]
    for name in names:
        made = message_of(Ros2Link(type=name, subscribe="/x", to="x"), JAZZY)
        assert JAZZY.encode(name, JAZZY.like(name, made())) == JAZZY.encode(
            name, JAZZY.blank(name)), name
    assert len(names) > 100


def test_a_list_of_messages_is_written_with_only_the_fields_that_are_set():
    kind = "diagnostic_msgs/msg/DiagnosticArray"
    source = message_of(Ros2Link(type=kind, subscribe="/x", to="x"), JAZZY)
    message = msgspec.convert({"status": [
        {"name": "lidar", "level": 2, "values": [{"key": "heat", "value": "91"}]}, {}]}, source)
    written = JAZZY.decode(kind, said(kind, source)(message, 0))
    assert [(one.name, one.level, one.message, [(v.key, v.value) for v in one.values])
            for one in written.status] == [
        ("lidar", 2, "", [("heat", "91")]), ("", 0, "", [])]


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
