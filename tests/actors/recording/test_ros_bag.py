"""Recordings as bags of ROS 2, read by a reader that is not ours, from the definitions in them."""

from __future__ import annotations

import asyncio
import json
import struct
import time
from types import SimpleNamespace

import msgspec
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.rosbag2 import Reader

from rampart.actors.bus.envelope import Header, encode
from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.recording.bag_reader import BagReader
from rampart.actors.recording.bag_writer import BagWriter
from rampart.actors.recording.ros_bag import RosBag
from rampart.actors.recording.ros_structs import StructTypes
from rampart.actors.ros2.node import RosNode
from rampart.actors.ros2.side import ZenohSide, packed, recorded_key
from rampart.actors.ros2.translation.types import Types
from rampart.actors.ros2.wire import Qos, data_key, dds_name
from rampart.cli.main import main
from tests import ROOT
from tests.actors.recording.samples import documents, pose, sample, small_disk, write
from tests.fuzz.message_extremes import all_topics
from tests.fuzz.message_extremes import sample as some

JAZZY = Types("jazzy")
TWIST = "geometry_msgs/msg/Twist"


def decoded(folder):
    """Read the MCAP of a bag: topic → type and messages."""
    found = {}
    (path,) = folder.glob("*.mcap")
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        assert reader.get_header().profile == "ros2"
        for schema, channel, message, said in reader.iter_decoded_messages():
            assert (schema.encoding, channel.message_encoding) == ("ros2msg", "cdr")
            found.setdefault(channel.topic, (schema.name, []))[1].append((message.log_time, said))
    return found


def made(path, folder, *more, code=0):
    assert main(["bag", "ros2", str(path), str(folder), *more]) == code
    return decoded(folder)


def twist(speed_mps):
    message = JAZZY.blank(TWIST)
    message.linear.x = speed_mps
    return JAZZY.encode(TWIST, message)


def passed(topic, kind, data, digest=None):
    key = data_key(0, topic, dds_name(kind), digest or JAZZY.hash(kind))
    return recorded_key(key), packed(data, b"")


def plain(value):
    """Return what a reader of ROS 2 sees as a message of the system would have it."""
    if hasattr(value, "__slots__"):
        return {name: plain(getattr(value, name)) for name in value.__slots__}
    if isinstance(value, list | tuple):
        return [plain(one) for one in value]
    return value


def expected(value):
    """Return what a message of the system is to be in ROS 2, said once more in another way."""
    if isinstance(value, msgspec.Struct):
        return {name.strip("_"): expected(getattr(value, name)) for name in value.__struct_fields__
                if not isinstance(getattr(value, name), msgspec.UnsetType)}
    if isinstance(value, dict):
        return [{"key": key, "value": expected(one)} for key, one in value.items()]
    if isinstance(value, list | tuple | frozenset):
        return [expected(one) for one in value]
    return getattr(value, "value", value)


# ---- what is in it -------------------------------------------------------------------------------


def test_poses_detections_and_views_are_read_by_others(recording, tmp_path, capsys):
    found = made(recording, tmp_path / "bag")
    name, poses = found["/rampart/localization/pose"]
    assert name == "rampart_bus/msg/PoseMessage"
    assert [said.body.x_m for _, said in poses] == [float(i + 1) for i in range(20)]
    assert poses[3][1].body.yaw_rad != poses[3][1].body.yaw_rad, "NaN stays what it is"
    one_ns, one = poses[2]
    assert (one.node, one.incarnation, one.sequence, one.header.frame_id) == (
        "localization", 1, 3, "map")
    assert one.header.stamp.sec * 10**9 + one.header.stamp.nanosec == one_ns == 100_000_000
    name, reports = found["/rampart/detection/DM1"]
    assert [(said.body.state, said.body.reason) for _, said in reports] == [
        ("active", "it is there"), ("idle", "")]
    assert {topic: kind for topic, (kind, _) in found.items() if "rampart" not in topic} == {
        "/tf": "tf2_msgs/msg/TFMessage", "/rosout": "rcl_interfaces/msg/Log",
        "/view/pose": "geometry_msgs/msg/PoseStamped",
        **{f"/view/{scene}": "visualization_msgs/msg/MarkerArray"
           for scene in ("map", "lights", "robot")}}
    assert [t.child_frame_id for t in found["/tf"][1][0][1].transforms] == ["odom", "base_link"]
    assert next((said.level, said.name) for _, said in found["/rosout"][1]) == (30, "DM1")
    assert len(found["/view/map"][1][0][1].markers) > 10
    out = capsys.readouterr().out
    assert "left out: no/such/topic: no known actor declares it (1 times)" in out
    assert "left out: localization/pose: " in out, "garbage is no message"


def test_a_sweep_is_in_the_frame_of_its_laser(tmp_path):
    sweep = m.LaserScan(angle_min_rad=-1.0, angle_increment_rad=0.5, range_max_m=30.0,
                        ranges_f32=struct.pack("<5f", 1, 2, float("nan"), 3, 4))
    write(tmp_path / "run.mcap", [
        (0.1, topics.SCAN.at(), encode(Header("simulator", 1, 1, 0.1), sweep))])
    found = made(tmp_path / "run.mcap", tmp_path / "bag")
    seen = found["/view/scan"][1][0][1]
    assert (seen.header.frame_id, seen.angle_min, seen.angle_max) == ("view_scan", -1.0, 1.0)
    assert list(seen.ranges) == [1.0, 2.0, 0.0, 3.0, 4.0], "what is nearer than range_min is none"
    assert seen.range_min > 0
    assert found["/tf"][1][0][1].transforms[0].child_frame_id == "view_scan"
    assert list(found["/rampart/summit_xl/scan"][1][0][1].body.ranges_f32)[:2] == [1.0, 2.0]


@pytest.mark.parametrize("topic", all_topics(), ids=lambda topic: topic.key)
def test_each_type_of_the_system_is_read_from_its_definition(topic):
    types = Types("jazzy")
    name, make = StructTypes(types).encoder(topic)
    body = some(topic.type)
    data = make(Header("a", 2, 3, 0.5), body, 1_500_000_000)
    text, _ = types.definition(name)
    decode = DecoderFactory().decoder_for("cdr", SimpleNamespace(
        id=1, name=name, encoding="ros2msg", data=text.encode()))
    said = decode(data)
    assert (said.node, said.incarnation, said.sequence, said.header.stamp.nanosec) == (
        "a", 2, 3, 500_000_000)
    want = expected(body)
    got = plain(said.body) if want and hasattr(said, "body") else {}
    for field, value in want.items():
        if isinstance(value, bytes):
            continue
        assert is_said(got.get(field.lower()), value), (field, value, got.get(field.lower()))


def is_said(got, want):
    """Whether a field says what it is to say; one that may be missing is a list of it."""
    if isinstance(want, dict) and isinstance(got, dict):
        return all(isinstance(one, bytes) or is_said(got.get(name), one)
                   for name, one in want.items())
    if isinstance(got, str) and not isinstance(want, str):
        return json.loads(got) == json.loads(msgspec.json.encode(want))
    if isinstance(got, list) and isinstance(want, list):
        return len(got) == len(want) and all(map(is_said, got, want))
    if isinstance(got, list):
        return got == [] if want is None else len(got) == 1 and is_said(got[0], want)
    if isinstance(got, dict) and set(got) == {"items"}:
        return is_said(got["items"], want)
    return got == want or (want in (None, [], {}) and not got)


def test_what_passed_the_gateway_is_there_byte_for_byte(tmp_path):
    path = tmp_path / "run.mcap"
    writer = BagWriter(path.open("wb"), documents())
    for number in range(3):
        writer.take(number / 10, *passed("/robot/cmd_vel", TWIST, twist(number)))
    writer.take(0.5, *passed("/robot/cmd_vel", TWIST, twist(9.0), "RIHS01_" + "0" * 64))
    writer.take(0.6, "ros2-side/tokens/gateway", b"x")
    assert writer.garbage == 0
    writer.close()
    found = made(path, tmp_path / "bag")
    assert list(found) == ["/robot/cmd_vel"]
    kind, said = found["/robot/cmd_vel"]
    assert (kind, [one.linear.x for _, one in said]) == (TWIST, [0.0, 1.0, 2.0])
    with Reader(tmp_path / "bag") as reader:
        (connection,) = reader.connections
        assert connection.digest == JAZZY.hash(TWIST)
        assert [bytes(data) for *_, data in reader.messages()] == [twist(n) for n in range(3)]


async def test_what_the_gateway_says_and_hears_is_handed_to_the_recorder_as_it_travelled():
    taken = []
    side = ZenohSide([], asyncio.get_running_loop(), mode="peer")
    node = RosNode(side, JAZZY, "rampart", wall_ns=time.time_ns, refuse=lambda *_: None,
                   record=lambda *what: taken.append(what))
    node.subscribe("/cmd_vel", TWIST, Qos(), lambda *_: None)
    say = node.publisher("/cmd_vel", TWIST, Qos())
    async with asyncio.timeout(10):
        while len(taken) == len(set(taken)):  # each message is recorded once on either way
            say(twist(1.0))
            await asyncio.sleep(0.02)
    side.close()
    key = data_key(0, "/cmd_vel", dds_name(TWIST), JAZZY.hash(TWIST))
    assert {(where, msgspec.msgpack.decode(one)[0]) for where, one in taken} == {
        (recorded_key(key), twist(1.0))}


def test_definitions_of_a_robot_s_own_are_those_of_its_system(tmp_path, capsys):
    brake, path = "summit_xl_msgs/msg/Brake", tmp_path / "run.mcap"
    types = Types("jazzy", [ROOT / "systems/osmosis-ros2"])
    writer = BagWriter(path.open("wb"), documents())
    writer.take(0.1, *passed("/brake", brake, types.encode(brake, types.blank(brake)),
                             types.hash(brake)))
    writer.take(0.2, *pose(1, 0.2)[1:])
    writer.close()
    assert "/brake" not in made(path, tmp_path / "without")
    assert f"type '{brake}' is not known to jazzy" in capsys.readouterr().out
    kind, said = made(path, tmp_path / "with", "--system", "osmosis-ros2")["/brake"]
    assert (kind, said[0][1].engaged) == (brake, False)


def test_a_newcomer_to_a_replayed_bag_is_told_what_stays(tmp_path):
    report = fm.DetectionReport(fm.DetectionState.IDLE, "", (), 0.2)
    write(tmp_path / "run.mcap", [pose(1, 0.1), (0.2, ftm_topics.DETECTION.at("DM1"), encode(
        Header("DM1", 1, 1, 0.2), report))])
    made(tmp_path / "run.mcap", tmp_path / "bag")
    with Reader(tmp_path / "bag") as reader:
        kept = {c.topic: c.ext.offered_qos_profiles[0].durability.name for c in reader.connections}
    assert kept["/rampart/detection/DM1"] == "TRANSIENT_LOCAL"
    assert kept["/rampart/localization/pose"] == "VOLATILE"


# ---- what is refused -----------------------------------------------------------------------------


def test_bad_words_are_refused_and_nothing_is_left_behind(tmp_path, refused):
    path = tmp_path / "run.mcap"
    write(path, sample(3))
    (tmp_path / "there").mkdir()
    (tmp_path / "none.mcap").write_bytes(b"nothing of the kind")
    for words, told in (
            ([path, tmp_path / "there"], "exists already; choose another name"),
            ([path, tmp_path / "new", "--distribution", "foxy"],
             "--distribution = 'foxy': unknown; known: humble, iron, jazzy, kilted"),
            ([tmp_path / "none.mcap", tmp_path / "new"], "not an MCAP file"),
            ([path, "/proc/nowhere/bag"], "/proc/nowhere/bag: No such file or directory"),
            ([path, tmp_path / "new", "--system", "nosuch"], "nosuch")):
        assert told in refused("bag", "ros2", *words)
        assert not (tmp_path / "new").exists()


def test_a_full_disk_leaves_no_half_bag(tmp_path):
    path = tmp_path / "run.mcap"
    write(path, sample(400))
    with small_disk(20_000):
        assert main(["bag", "ros2", str(path), str(tmp_path / "bag")]) == 2
    assert not (tmp_path / "bag").exists()


def test_a_bag_of_an_older_distribution_can_be_read(tmp_path):
    write(tmp_path / "run.mcap", sample(3))
    bag = RosBag(Types("humble"), (*topics.ALL, *ftm_topics.ALL))
    bag.write(BagReader(tmp_path / "run.mcap"), tmp_path / "bag")
    assert len(decoded(tmp_path / "bag")["/rampart/localization/pose"][1]) == 3
