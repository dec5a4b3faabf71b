"""The wire format beside captures of a live rmw_zenoh_cpp (Humble, 0.1.8), and what is none."""

import asyncio
import time

import msgspec
import pytest

from rampart.actors.ros2 import wire
from rampart.actors.ros2.node import RosNode
from rampart.actors.ros2.side import ZenohSide, recorded_key
from rampart.actors.ros2.translation.types import Types
from rampart.actors.ros2.wire import Endpoint, EndpointKind, Qos

CAPTURED = ("@ros2_lv/0/9ca0f8facf84ffb1e6bfa4f2500889f0/0/3/MP/%/%/_ros2cli_712/%chatter/"
            "std_msgs::msg::dds_::String_/TypeHashNotSupported/:1:,1:,:,:,,")
ATTACHED = bytes.fromhex("d80000000000000034dae10162f8c41810f07168d3856ce9f689254cbed6252151")


def test_a_captured_token_is_read_and_written_the_same():
    found = Endpoint.parse(CAPTURED)
    assert (found.full_name, found.topic, found.kind) == (
        "/_ros2cli_712", "/chatter", EndpointKind.PUBLISHER)
    assert found.qos == Qos(transient_local=True, depth=1)
    assert found.token == CAPTURED
    assert found.key == "0/chatter/std_msgs::msg::dds_::String_/TypeHashNotSupported"


def test_the_gid_of_a_captured_attachment_is_that_of_the_captured_token():
    attachment = wire.Attachment.unpack(ATTACHED)
    assert attachment.gid == Endpoint.parse(CAPTURED).gid
    assert attachment.sequence == 216
    assert attachment.pack() == ATTACHED


def test_nodes_in_namespaces_and_keys():
    node = Endpoint(7, "ab", "1", "1", EndpointKind.NODE, "amcl", "/robot/front")
    assert node.token == "@ros2_lv/7/ab/1/1/NN/%/%robot%front/amcl"
    assert Endpoint.parse(node.token) == node
    assert node.full_name == "/robot/front/amcl"
    assert wire.data_key(7, "/a/b/", wire.dds_name("nav_msgs/msg/Path"), "RIHS01_0") == (
        "7/a/b/nav_msgs::msg::dds_::Path_/RIHS01_0")
    assert wire.ros_name("std_srvs::srv::dds_::Trigger_") == "std_srvs/srv/Trigger"
    assert wire.ros_name("what") == "what"
    for qos, text in ((Qos(), "::,:,:,:,,"), (Qos(reliable=False, depth=7), "2::,7:,:,:,,"),
                      (Qos(transient_local=True, keep_all=True, depth=5), ":1:2,5:,:,:,,")):
        assert (qos.token(), Qos.parse(text)) == (text, qos)


@pytest.mark.parametrize("token", [
    CAPTURED, f"{CAPTURED}/more", CAPTURED.replace(":1:,1:,:,:,,", ":1:,1:2,0:,:,,")])
def test_the_graph_knows_an_endpoint_by_the_id_of_its_whole_token(token):
    graph, gid = wire.RosGraph(), wire.gid_of(token)
    graph.changed(token, True)
    assert graph.endpoint(gid).node == "_ros2cli_712"
    graph.changed(token, False)
    assert graph.endpoint(gid) is None


@pytest.mark.parametrize("token", [
    "", "@ros2_lv", "x" * 1000, CAPTURED.replace("@ros2_lv", "@other"),
    CAPTURED.replace("/0/9c", "/x/9c"), CAPTURED.replace("/MP/", "/XX/"), CAPTURED[:60],
    CAPTURED.replace("/:1:,1:,:,:,,", ""), CAPTURED.replace(":1:,1:,:,:,,", "1"),
    CAPTURED.replace(",1:", ",x:"), CAPTURED.replace("_ros2cli_712", "")])
def test_what_is_no_token_is_one_line(token):
    with pytest.raises(ValueError, match=r"^[^\n]{1,400}\Z"):
        Endpoint.parse(token)


@pytest.mark.parametrize("data", [None, b"", ATTACHED[:-1], ATTACHED + b"\0",
                                  ATTACHED[:16] + b"\x11" + ATTACHED[17:]])
def test_what_is_no_attachment_is_one_line(data):
    with pytest.raises(ValueError, match="attachment"):
        wire.Attachment.unpack(data)


def endpoint(kind, node="a", **what):
    said = {"topic": "/odom", "type": "t", "hash": "h", **what}
    return Endpoint(0, node, "0", "1", kind, node, **said)


@pytest.mark.parametrize(("there", "words"), [
    (endpoint(EndpointKind.PUBLISHER, "b"), None),
    (endpoint(EndpointKind.SUBSCRIPTION, "b", hash="x"), None),
    (endpoint(EndpointKind.PUBLISHER, "b", topic="/other", type="x"), None),
    (endpoint(EndpointKind.PUBLISHER, "b", type="x"), "/odom: /b has the type x; expected t"),
    (endpoint(EndpointKind.PUBLISHER, "b", hash="x"), "they exchange nothing"),
    (endpoint(EndpointKind.PUBLISHER, "b", qos=Qos(reliable=False)), "offers best effort")])
def test_who_cannot_meet_is_told(there, words):
    mine = endpoint(EndpointKind.SUBSCRIPTION, qos=Qos(transient_local=True))
    assert "keeps none" in next(wire.misfits([mine], [endpoint(EndpointKind.PUBLISHER, "b")]))
    found = list(wire.misfits([endpoint(EndpointKind.SUBSCRIPTION)], [there]))
    assert [words in one for one in found] == ([True] if words else [])


def test_the_graph_is_bounded_and_forgets_who_has_gone():
    graph = wire.RosGraph()
    assert graph.changed(CAPTURED, True).node == "_ros2cli_712"
    assert graph.changed(CAPTURED, True) is None
    assert graph.changed(CAPTURED, False) is not None
    assert graph.changed(CAPTURED, False) is None
    for number in range(wire.MOST_TOKENS):
        graph.changed(f"@ros2_lv/0/a/{number}/{number}/NN/%/%/n", True)
    with pytest.raises(ValueError, match="more than"):
        graph.changed(CAPTURED, True)
    assert graph.nodes() == {"/n": wire.MOST_TOKENS}


async def test_what_a_node_says_and_hears_is_handed_to_the_recorder_as_it_travelled():
    types, taken, twist = Types("jazzy"), [], "geometry_msgs/msg/Twist"
    side = ZenohSide([], asyncio.get_running_loop(), mode="peer")
    node = RosNode(side, types, "rampart", wall_ns=time.time_ns, refuse=lambda *_: None,
                   record=lambda *what: taken.append(what))
    node.subscribe("/cmd_vel", twist, Qos(), lambda *_: None)
    say, payload = node.publisher("/cmd_vel", twist, Qos()), types.encode(twist, types.blank(twist))
    async with asyncio.timeout(10):
        while len(taken) == len(set(taken)):  # each message is recorded once on either way
            say(payload)
            await asyncio.sleep(0.02)
    side.close()
    key = recorded_key(wire.data_key(0, "/cmd_vel", wire.dds_name(twist), types.hash(twist)))
    assert {(where, msgspec.msgpack.decode(one)[0]) for where, one in taken} == {(key, payload)}
